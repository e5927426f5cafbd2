"""Small images with something in them to learn: two colours, a place, and a label for each."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from derender.baselines import baseline_config, train_baseline
from derender.baselines.model import LossInputs
from derender.data import ImageSet
from derender.report.run import sample_sheet

COMMON = ["image_size=32", "batch_size=8", "checkpoint_every=24", "validate_every=24", "sample_every=48"]
OWN = {
    **{name: ["width=8", "code_size=16"] for name in ("simclr", "ae", "beta-vae")},
    "vqvae": ["width=8", "codes=8"],
    "stylegan2": [
        *("style_size=6", "mapping_layers=2", "channel_base=64", "channel_max=6"),
        *("r1_every=3", "path_every=2"),  # in both halves of a run of six steps
    ],
    "e4e": ["width=4", "units=[1,1,1,1]", "self_features_steps=2", "first_release=8"],
}


def config(name: str, images: int, *more: str):
    return baseline_config(name, [*COMMON, *OWN[name], "deterministic=true", f"images={images}", *more])


def generator_of(name: str, folder) -> list[str]:
    """The setting that names the generator which e4e inverts."""
    return [f"generator={folder / 'stylegan2'}"] if name == "e4e" else []


@pytest.fixture(scope="session")
def runs(blobs, tmp_path_factory):
    """One finished run of each, by name."""
    folder = tmp_path_factory.mktemp("runs")
    for name in OWN:
        own = config(name, 48, *generator_of(name, folder))
        train_baseline(own, blobs, folder / name, sample_sheet=sample_sheet)
    torch.use_deterministic_algorithms(False)
    return folder


@pytest.fixture(scope="session")
def blobs() -> ImageSet:
    """48 images of 32x32: a bright square on a dark ground, left (label 0) or right (label 1)."""
    random = np.random.default_rng(0)
    images = random.integers(0, 60, (48, 3, 32, 32), dtype=np.uint8)
    side = np.arange(48) % 2
    for image, right in zip(images, side, strict=True):
        row, column = random.integers(4, 16), 18 if right else 2
        image[:, row : row + 10, column : column + 10] = random.integers(120, 256, (3, 1, 1))
    labels = {"side": side, "shade": np.array(["dark", "light"])[side], "same": np.zeros(48, int)}
    return ImageSet(images, tuple(f"{i:02d}.png" for i in range(48)), labels, source="made by the test")


@pytest.fixture(scope="session")
def losses():
    """The losses of a batch, whose random numbers come from a seed or a generator."""

    def of(model, images, config, random=0, aid=None) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(random) if isinstance(random, int) else random
        return model.losses(images, LossInputs(config, generator, nullcontext, aid))

    return of


@pytest.fixture(scope="session")
def seeded():
    """Build something with the global generator at a seed, and leave that as it was."""

    def build(function, *arguments, seed=0, **named):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return function(*arguments, **named)

    return build
