"""Writes what this release saves, as small as can be, for later releases to read: run once for each release.

    python tests/trust/releases/make.py

makes ``tests/trust/releases/VERSION``: a model with whitening, a table, a checkpoint, the configuration
of a run, and in ``expected.json`` the numbers that they gave. tests/trust/test_releases.py reads all of them.
"""

import json
from pathlib import Path

import numpy as np
import torch
from torch import nn

import derender
from derender.features import FeatureTable
from derender.model import Derenderer
from derender.networks import NetworkSettings
from derender.presets import ModelSettings
from derender.scene.perturb import PerturbSettings
from derender.storage.places import WHITENING_FILE
from derender.training import resolve
from derender.training.checkpoint import TrainState, save_checkpoint
from derender.training.config import WhiteningSettings
from derender.training.features import fit_whitening
from derender.training.run_folder import append_metrics, start_run

HERE = Path(__file__).parent
SIZE = 32
SETTINGS = ModelSettings(
    network=NetworkSettings(image_size=SIZE, width=4, light_width=1, code_size=4, confidence_code_size=1)
)
PLACES = (5, 16, 27)


def pictures(count: int = 2) -> torch.Tensor:
    """(N, 3, 32, 32) in 0..1: waves of different lengths, rounded to bytes, so the same everywhere."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    results = [
        [np.sin((3 + number + channel) * x + (2 + channel) * y + number) for channel in range(3)]
        for number in range(count)
    ]
    return torch.from_numpy(np.round(127.5 + 120 * np.array(results)).astype(np.uint8)).float() / 255


def numbers_of(model: Derenderer) -> dict[str, list]:
    """What a model says of two images: features, light, camera; depth, albedo, rendering at nine places."""
    with torch.no_grad():
        scene, features = model.decompose(pictures()), model.embed(pictures())
        image = model.render(scene).image
    at = np.ix_(PLACES, PLACES)
    maps = {"depth": scene.depth[:, None], "albedo": scene.albedo, "image": image}
    result = {f"feature {name}": value for name, value in features.items()}
    result |= {"light": scene.light, "camera": scene.camera}
    result |= {name: torch.stack([one[..., at[0], at[1]] for one in value]) for name, value in maps.items()}
    return {name: value.double().numpy().round(7).tolist() for name, value in result.items()}


def table() -> FeatureTable:
    """Every kind of label, a missing one of each, and two factors of different width."""
    return FeatureTable(
        ("a.png", "Łódź/b c.png", "three\n.png"),
        {"geometry": np.arange(12).reshape(3, 4) / 7, "light": np.array([[0.0], [-1e-30], [3e30]])},
        {
            "age": np.array([31.5, np.nan, 4]),
            "smiling": np.array([1, -1, 0], np.int8),
            "track": np.array([7, 8, 2**40]),
            "name": np.array(["Zoë", "", "李"]),
            "emotion": np.array(["happy", None, "sad"], dtype=object),
        },
        {"data": "generated", "nested": {"list": [1, "two", None]}},
    )


def learner() -> tuple[nn.Module, torch.optim.Optimizer]:
    """The smallest thing that has weights and an optimiser."""
    net = nn.Sequential(nn.Linear(3, 2), nn.Linear(2, 1))
    return net, torch.optim.Adam(net.parameters(), lr=1e-2, betas=(0.8, 0.9), weight_decay=1e-3)


def main() -> None:
    """The script."""
    torch.set_num_threads(1)
    folder = HERE / derender.__version__
    folder.mkdir()
    model = Derenderer.seeded(SETTINGS, 0).eval()
    settings = WhiteningSettings(pictures=12, views=2, directions=4)
    whitening = fit_whitening(model, pictures(12), settings, PerturbSettings())
    whitening.save(model.save(folder / "model") / WHITENING_FILE)
    table().write(folder / "table.parquet")
    torch.manual_seed(0)
    net, optimiser = learner()
    net(torch.tensor([[1.0, 2, 3]])).sum().backward()
    optimiser.step()
    state = TrainState(640, seconds=1.5, best_loss=0.25, validations_since_best=2, watcher={"a": {"b": 1}})
    save_checkpoint(folder / "checkpoint", net, optimiser, state)
    config = resolve("small", ["image_size=32", "loocc=light", "learning_rate=2e-4", "split=[0.7, 0.2, 0.1]"])
    run = start_run(folder / "run", config, {"layout": "folder"}, "cpu")
    (run.path / "environment.json").unlink()  # names the machine
    run.samples.rmdir()
    append_metrics(run, {"kind": "train", "images": 640, "l1": 0.125})
    expected = {
        "model": numbers_of(derender.load(folder / "model")),
        "config": config.model_dump(mode="json"),
        "weights": {name: value.tolist() for name, value in net.state_dict().items()},
    }
    (folder / "expected.json").write_text(json.dumps(expected) + "\n")


if __name__ == "__main__":
    main()
