"""Commands that are killed: what each is given, what must be whole after every kill, and what comes out."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from safetensors.torch import load_file

from derender.features import FeatureTable
from derender.model import load
from derender.storage.atomic import check_seal

TRAINING = ("image_size=32", "width=8", "light_width=4", "batch_size=8", "self_features_steps=2")
TRAINING += ("checkpoint_every=24", "validate_every=48", "sample_every=48")
TRAINING += ("deterministic=true", "whitening.pictures=8")


@dataclass(frozen=True)
class Command:
    """A command that can be killed.

    Attributes:
        name: what it is called in the figures.
        arguments: of the first attempt and of later ones, given the folder it works in.
        sound: raises unless what lies in the folder is whole.
        result: what must be the same in the end, by name, as bytes.
    """

    name: str
    arguments: Callable[[Path], list[str]]
    sound: Callable[[Path], object]
    result: Callable[[Path], dict[str, bytes]]


def made_pictures(folder: Path, count: int) -> Path:
    """A folder of smooth random images of 32 pixels, and a tenth as many broken ones."""
    folder.mkdir(parents=True)
    draw = np.random.default_rng(0)
    for number in range(count):
        small = Image.fromarray(draw.integers(0, 256, (4, 4, 3), dtype=np.uint8))
        small.resize((32, 32)).save(folder / f"{number:03d}.png")
    for number in range(count // 10):
        (folder / f"broken{number}.png").write_bytes(b"no picture")
    return folder


def made_table(file: Path, seed: int, rows: int = 150) -> Path:
    """Features with an identity that one factor shows."""
    draw, identity = np.random.default_rng(seed), np.arange(rows) % 6
    geometry = draw.normal(size=(rows, 8)) + 2 * np.eye(8)[identity]
    labels = {"identity": np.array([f"person {value}" for value in identity])}
    factors = {"geometry": geometry, "albedo": draw.normal(size=(rows, 8))}
    return FeatureTable(tuple(f"{row}.png" for row in range(rows)), factors, labels).write(file)


def train_command(place: Path, images: int) -> Command:
    """Pre-training of a tiny model, with perceptual features, whitening and a report."""
    data = made_pictures(place / "pictures", 40)

    def arguments(folder: Path) -> list[str]:
        given = ["train", "--data", str(data), "--out", str(folder / "run"), "--device", "cpu"]
        given += [f"--set={setting}" for setting in (*TRAINING, f"images={images}")]
        resume = ["--resume"] if (folder / "run" / "config.yaml").exists() else []
        return [*given, "--preset", "small", *resume]

    def sound(folder: Path) -> None:
        for place in (folder / "run" / "checkpoints").glob("[!.]*"):
            check_seal(place)
        if (folder / "run" / "model").exists():
            load(folder / "run" / "model")

    def result(folder: Path) -> dict[str, bytes]:
        names = ("last/model", "last/optimiser", "best/model", "best/optimiser")
        kinds = [f"checkpoints/{name}" for name in names]
        return {
            name: tensor_bytes(folder / "run" / f"{name}.safetensors")
            for name in (*kinds, "model/model", "model/whitening", "perceptual")
        }

    return Command("train", arguments, sound, result)


def embed_command(place: Path, model: Path, pictures: int) -> Command:
    """Embedding of a folder; parts are small here, so that there are many."""
    data = made_pictures(place / "more", pictures)

    def arguments(folder: Path) -> list[str]:
        table = folder / "table.parquet"
        given = ["embed", "--model", str(model), "--data", str(data), "--out", str(table)]
        return [*given, "--device", "cpu", "--batch-size", "4", *(["--force"] if table.exists() else [])]

    def sound(folder: Path) -> None:
        if (folder / "table.parquet").exists():
            FeatureTable.read(folder / "table.parquet")

    def result(folder: Path) -> dict[str, bytes]:
        table = FeatureTable.read(folder / "table.parquet")
        factors = {name: value.tobytes() for name, value in table.factors.items()}
        return {"file": "\n".join(table.files).encode(), **factors}

    return Command("embed", arguments, sound, result)


def compare_command(place: Path) -> Command:
    """A comparison of two features that remembers what it has computed."""
    tables = [made_table(place / f"{name}.parquet", seed) for seed, name in enumerate(("one", "two"))]
    written = ("scores.json", "scores.md")

    def arguments(folder: Path) -> list[str]:
        given = ["compare", "--table", "identity", "--resamples", "60", "--cache", str(folder / "cache")]
        given += [f"--features={table.stem}={table}" for table in tables]
        return [*given, "--json", str(folder / written[0]), "--markdown", str(folder / written[1]), "--force"]

    def sound(folder: Path) -> None:
        if (folder / "scores.json").exists():
            json.loads((folder / "scores.json").read_text())

    def result(folder: Path) -> dict[str, bytes]:
        return {name: (folder / name).read_bytes() for name in written}

    return Command("compare", arguments, sound, result)


def tensor_bytes(file: Path) -> bytes:
    """Names and values of a safetensors file."""
    tensors = sorted(load_file(file).items())
    return b"".join(name.encode() + value.numpy().tobytes() for name, value in tensors)
