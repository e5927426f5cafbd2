"""Commands that are killed: what each is given, what must be whole after every kill, and what comes out."""

import json
import sys
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
EVERY = ("checkpoint_every=24", "validate_every=48", "sample_every=48")
EVERY += ("deterministic=true", "whitening.pictures=8")


@dataclass(frozen=True)
class Command:
    """A command that can be killed.

    Attributes:
        name: what it is called in the figures.
        arguments: of the first attempt and of later ones, given the folder it works in.
        sound: raises unless what lies in the folder is whole.
        result: what must be the same in the end, by name, as bytes.
        quick: writes files faster than one can look, and has to be stopped in the midst of one (Linux).
    """

    name: str
    arguments: Callable[[Path], list[str]]
    sound: Callable[[Path], None]
    result: Callable[[Path], dict[str, bytes]]
    quick: bool = False


def made_pictures(folder: Path, count: int = 40, size: int = 32) -> Path:
    """A folder of smooth random images, a tenth of them broken."""
    folder.mkdir(parents=True)
    random_numbers = np.random.default_rng(0)
    for number in range(count):
        small = Image.fromarray(random_numbers.integers(0, 256, (4, 4, 3), dtype=np.uint8))
        small.resize((size, size)).save(folder / f"{number:03d}.png")
    for number in range(count // 10):
        (folder / f"broken{number}.png").write_bytes(b"no picture")
    return folder


def made_table(file: Path, seed: int, rows: int = 150) -> Path:
    """Features with an identity that one factor shows."""
    random_numbers = np.random.default_rng(seed)
    identity = np.arange(rows) % 6
    geometry = random_numbers.normal(size=(rows, 8)) + 2 * np.eye(8)[identity]
    factors = {"geometry": geometry, "albedo": random_numbers.normal(size=(rows, 8))}
    names = tuple(f"{row}.png" for row in range(rows))
    labels = {"identity": np.array([f"person {value}" for value in identity])}
    return FeatureTable(names, factors, labels).write(file)


def train_command(data: Path, images: int) -> Command:
    """Pre-training of a tiny model, with perceptual features, whitening and a report."""
    chosen = [text for setting in (*TRAINING, *EVERY, f"images={images}") for text in ("--set", setting)]

    def arguments(folder: Path) -> list[str]:
        given = ["train", "--data", str(data), "--out", str(folder / "run"), "--device", "cpu"]
        resume = ["--resume"] if (folder / "run" / "config.yaml").exists() else []
        return [*given, "--preset", "small", *chosen, *resume]

    def sound(folder: Path) -> None:
        for place in ("last", "previous", "best"):
            if (folder / "run" / "checkpoints" / place).exists():
                check_seal(folder / "run" / "checkpoints" / place)
        if (folder / "run" / "model").exists():
            load(folder / "run" / "model")

    def result(folder: Path) -> dict[str, bytes]:
        run = folder / "run"
        names = [
            f"checkpoints/{place}/{name}" for place in ("last", "best") for name in ("model", "optimiser")
        ]
        names += ["model/model", "model/whitening", "perceptual"]
        files = [run / f"{name}.safetensors" for name in names]
        return {str(file.relative_to(run)): tensor_bytes(file) for file in files}

    return Command("train", arguments, sound, result)


def embed_command(model: Path, data: Path) -> Command:
    """Embedding of a folder; parts are small here, so that there are many."""

    def arguments(folder: Path) -> list[str]:
        table = folder / "table.parquet"
        given = ["embed", "--model", str(model), "--data", str(data), "--out", str(table)]
        given += ["--device", "cpu", "--batch-size", "4"]
        return [*given, "--force"] if table.exists() else given

    def sound(folder: Path) -> None:
        if (folder / "table.parquet").exists():
            FeatureTable.read(folder / "table.parquet")

    def result(folder: Path) -> dict[str, bytes]:
        table = FeatureTable.read(folder / "table.parquet")
        return {
            "file": "\n".join(table.files).encode(),
            **{name: value.tobytes() for name, value in table.factors.items()},
        }

    return Command("embed", arguments, sound, result)


def compare_command(tables: list[Path]) -> Command:
    """A comparison of two features that remembers what it has computed."""

    def arguments(folder: Path) -> list[str]:
        given = ["compare", "--table", "identity", "--resamples", "60", "--cache", str(folder / "cache")]
        named = [text for table in tables for text in ("--features", f"{table.stem}={table}")]
        written = ["--json", str(folder / "scores.json"), "--markdown", str(folder / "scores.md")]
        return [*given, *named, *written, "--force"]

    def sound(folder: Path) -> None:
        if (folder / "scores.json").exists():
            json.loads((folder / "scores.json").read_text())

    def result(folder: Path) -> dict[str, bytes]:
        return {name: (folder / name).read_bytes() for name in ("scores.json", "scores.md")}

    return Command("compare", arguments, sound, result, quick=sys.platform == "linux")


def tensor_bytes(file: Path) -> bytes:
    """Names and values of a safetensors file."""
    return b"".join(
        name.encode() + value.numpy().tobytes() for name, value in sorted(load_file(file).items())
    )
