"""What commands are killed over, and what they leave: a small data set, a model, a run, a plan; whole or not.

Everything is made from one seed, so that two runs of a command leave the same bytes.
"""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file

from derender.baselines import load_baseline
from derender.features import FeatureTable
from derender.model import Derenderer, load
from derender.photo.video import write_video
from derender.postprocess import Features
from derender.report.viewer.images import rendered_examples
from derender.scene.perturb import PerturbSettings
from derender.storage.atomic import check_seal
from derender.training.config import WhiteningSettings, resolve, to_yaml
from derender.training.features import fit_whitening

UNTIMED = ("metrics.jsonl", "environment.json", "state.json", "checksums.json", "report.html", "run.lock")
"""Files that hold times or checksums of such."""
APART = {"cache", "tensorboard", "samples", "previous", "jobs", "logs"}
PLAN = """
images: 48
image_size: 32
settings: {image_size: 32, checkpoint_every: 16, validate_every: 32, batch_size: 8, deterministic: true}
train: {own: {data: DATA}}
methods: {ae: {settings: {width: 4, code_size: 8}}, vqvae: {settings: {width: 4, codes: 8}}, hog: {}}
score: {own: {data: DATA, trained_on: own, label: class}}
untrained_seeds: 1
resamples: 50
"""


def content_of(file: Path) -> bytes:
    """What a file holds, wherever tensors lie in it; raises unless it is whole."""
    content = file.read_bytes()
    match file.suffix:
        case ".safetensors":
            tensors = sorted(load_file(file).items())
            return b"".join(name.encode() + value.numpy().tobytes() for name, value in tensors)
        case ".parquet":
            table = FeatureTable.read(file)
            return "\n".join(table.files).encode() + b"".join(one.tobytes() for one in table.factors.values())
        case ".json":
            json.loads(content)
            content = re.sub(rb'seconds": [0-9.e-]+', b"", content)
        case ".png" | ".gif" | ".jpg":
            with Image.open(file) as image:
                image.load()
        case ".mp4" if b"moov" not in content:
            raise ValueError(f"{file} is cut off")
        case ".glb" if int.from_bytes(content[8:12], "little") != len(content):
            raise ValueError(f"{file} is cut off")
    return content


def left_in(folder: Path) -> dict[str, bytes]:
    """What lies in a folder under final names; raises unless all of it is whole, models load, seals hold."""
    results = {}
    for file in sorted(folder.rglob("*")):
        inner = file.relative_to(folder)
        if any(part.startswith(".") or part.endswith(".partial") for part in inner.parts):
            continue
        if file.is_dir() and inner.parts[0] != "cache":
            if file.parent.name == "checkpoints":
                check_seal(file)
            elif (file / "config.json").exists():
                (load_baseline if "baseline" in (file / "config.json").read_text() else load)(file)
        elif file.is_file() and not APART & set(inner.parts):
            content = content_of(file)
            if file.name not in UNTIMED:
                results[str(inner)] = content
    return results


def made_material(place: Path, pictures: int) -> dict[str, str]:
    """Smooth random images in two classes, a tenth as many broken ones, two photographs, two tables."""
    draw, data = np.random.default_rng(0), place / "data"
    for number in range(pictures):
        folder = data / "ab"[number % 2]
        folder.mkdir(parents=True, exist_ok=True)
        small = Image.fromarray(draw.integers(0, 256, (4, 4, 3), dtype=np.uint8))
        small.resize((32, 32)).save(folder / f"{number:03d}.png")
        if number % 10 == 0:
            (folder / f"broken{number}.png").write_bytes(b"no picture")
        if number < 2:
            small.resize((96, 80)).save(place / f"photo{number}.png")
    identity = np.arange(150) % 6
    for name in ("one", "two"):
        geometry = draw.normal(size=(150, 8)) + 2 * np.eye(8)[identity]
        factors = {"geometry": geometry, "albedo": draw.normal(size=(150, 8))}
        labels = {"identity": np.array([f"person {value}" for value in identity])}
        files = tuple(f"{row}.png" for row in range(150))
        FeatureTable(files, factors, labels).write(place / f"{name}.parquet")
    faces = rendered_examples("rendered-faces-64", 64)
    for number in range(3):
        (place / "faces").mkdir(exist_ok=True)
        Image.fromarray(faces[number].picture).resize((160, 160)).save(place / "faces" / f"{number}.png")
    clip = (draw.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(4))
    write_video(place / "clip.mp4", clip, (64, 48), 10.0)
    names = {"DATA": "data", "FACES": "faces", "CLIP": "clip.mp4", "PHOTO2": "photo1.png"}
    names |= {"PHOTO": "photo0.png", "ONE": "one.parquet", "TWO": "two.parquet"}
    return {word: str(place / name) for word, name in names.items()}


def made_runs(place: Path, data: str, model: str) -> dict[str, str]:
    """The folder of a training with that model, and a plan of two trainings."""
    run = place / "run"
    shutil.copytree(model, run / "model")
    (run / "config.yaml").write_text(to_yaml(resolve("small", ["image_size=32", "width=4", "light_width=4"])))
    rows = [{"kind": "train", "images": 16 * row, "seconds": row, "l1": 1 / (row + 1)} for row in range(9)]
    (run / "metrics.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    plan = place / "plan.yaml"
    plan.write_text(PLAN.replace("DATA", json.dumps(data)))
    return {"RUN": str(run), "PLAN": str(plan)}


def made_model(place: Path) -> str:
    """A small untrained model with whitened features; what it writes is judged by bytes only."""
    model = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)
    images = torch.rand(8, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    features = fit_whitening(model, images, WhiteningSettings(views=1), PerturbSettings())
    return str(model.with_features(Features(features)).save(place / "model"))
