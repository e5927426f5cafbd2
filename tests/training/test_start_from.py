"""A run that begins with a trained model's weights: same model, exact resume, refusals."""

import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import derender
from derender.data import ImageSet
from derender.training import resolve, train
from derender.training.checkpoint import WEIGHTS_FILE
from derender.training.derender_task import DerenderTask

TINY = ["image_size=32", "width=8", "light_width=4", "code_size=16"]
SHORT = ["perceptual=none", "batch_size=8", "checkpoint_every=16", "validate_every=16", "warmup_images=0"]
SHORT += ["final_rate=1", "deterministic=true"]


@pytest.fixture(scope="module")
def pictures() -> ImageSet:
    images = np.random.default_rng(0).integers(0, 256, (40, 3, 32, 32), dtype=np.uint8)
    return ImageSet(images=images, files=tuple(f"{i:03d}.png" for i in range(40)), source="made by the test")


@pytest.fixture
def start(tmp_path):
    settings = resolve("small", [*TINY, "border_depth=1.07"]).model
    return derender.Derenderer.seeded(settings, seed=3).save(tmp_path / "start")


def test_the_model_and_its_weights_are_those_of_the_start_not_of_the_preset(start):
    config = resolve("small", SHORT, start_from=str(start))
    assert config.model.network.image_size == 32
    assert config.model.ranges.border_depth == 1.07
    begun = DerenderTask(config).build().state_dict()
    stored = derender.load(start).state_dict()
    assert all(torch.equal(begun[name], stored[name]) for name in stored)


def test_ranges_may_be_changed_but_other_networks_cannot_take_the_weights(start):
    config = resolve("small", [*SHORT, "border_depth=1.05"], start_from=str(start))
    assert DerenderTask(config).build().settings.ranges.border_depth == 1.05
    wider = resolve("small", [*SHORT, "width=16"], start_from=str(start))
    with pytest.raises(ValueError, match=r"cannot start from .* has shape .*network settings"):
        DerenderTask(wider).build()


def test_a_distilled_decoder_is_left_behind(tmp_path):
    settings = resolve("small", [*TINY, "encoder=unet", "unet_width=4"]).model
    network = settings.network.model_copy(update={"unet_decoder": True})
    distilled = derender.Derenderer.seeded(settings.model_copy(update={"network": network}), seed=3)
    distilled.save(tmp_path / "distilled")
    config = resolve("small", SHORT, start_from=str(tmp_path / "distilled"))
    begun = DerenderTask(config).build()
    assert begun.unet_decoder is None and config.model.network.encoder == "unet"
    weights = distilled.state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in begun.state_dict().items())
    with pytest.raises(ValueError, match="rendering trains none, derender unet distils one"):
        resolve("small", ["unet_decoder=true"])


def test_a_resumed_run_needs_the_start_no_more_and_ends_with_the_same_weights(start, pictures, tmp_path):
    whole_config = resolve("small", [*SHORT, "images=32"], start_from=str(start))
    half_config = resolve("small", [*SHORT, "images=16"], start_from=str(start))
    whole = train(whole_config, pictures, tmp_path / "whole")
    train(half_config, pictures, tmp_path / "half")
    shutil.rmtree(start)
    resumed = train(whole_config, pictures, tmp_path / "half", resume=True)
    assert resumed.images == whole.images == 32
    one, two = (load_file(run.folder / "checkpoints/last" / WEIGHTS_FILE) for run in (whole, resumed))
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)
