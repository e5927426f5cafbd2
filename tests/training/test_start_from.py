"""A run that begins with a trained model: its weights, exact resume, refusals; growth to a larger size."""

import json
import shutil

import numpy as np
import pytest
import torch
from tests.training.conftest import assert_same_weights, noise_set
from torch.nn.functional import avg_pool2d

import derender
from derender.data import ImageSet, split_indices
from derender.networks import NetworkSettings
from derender.objectives.reconstruction import depth_smoothness
from derender.postprocess import Features
from derender.scene.enlarge import doubled
from derender.training import resolve, train
from derender.training.config import with_changes
from derender.training.derender_task import DerenderTask
from derender.training.distillation import RefineConfig
from derender.training.distillation import refine as distil
from derender.training.features import fit_whitening

NETWORK = ["image_size=32", "width=8", "light_width=4", "code_size=16"]
BRIEF = ["perceptual=none", "batch_size=8", "checkpoint_every=16", "validate_every=16", "warmup_images=0"]
BRIEF += ["final_rate=1", "deterministic=true", "whitening.pictures=0", "fitting.examples=0"]


@pytest.fixture(scope="module")
def pictures() -> ImageSet:
    return noise_set(40)


@pytest.fixture
def given(tmp_path):
    settings = resolve("small", [*NETWORK, "border_depth=1.07"]).model
    return derender.Derenderer.seeded(settings, seed=3).save(tmp_path / "given")


def test_the_model_and_its_weights_are_those_of_the_start_not_of_the_preset(given):
    config = resolve("small", BRIEF, start_from=str(given))
    assert config.model.network.image_size == 32
    assert config.model.ranges.border_depth == 1.07
    begun = DerenderTask(config).build().state_dict()
    stored = derender.load(given).state_dict()
    assert all(torch.equal(begun[name], stored[name]) for name in stored)


def test_ranges_may_be_changed_but_other_networks_cannot_take_the_weights(given):
    config = resolve("small", [*BRIEF, "border_depth=1.05"], start_from=str(given))
    assert DerenderTask(config).build().settings.ranges.border_depth == 1.05
    wider = resolve("small", [*BRIEF, "width=16"], start_from=str(given))
    with pytest.raises(ValueError, match=r"cannot start from .* has shape .*network settings"):
        DerenderTask(wider).build()


def test_a_run_refined_at_last_is_one_that_is_refined_and_ends_so_again_when_resumed(pictures, tmp_path):
    few = [*BRIEF, "images=16", "whitening.pictures=8", "fitting.examples=32", "fitting.coordinates=4"]
    plain, refined = (resolve("small", [*NETWORK, *few, f"rounds={n}", "refining.images=16"]) for n in (0, 2))
    train(plain, pictures, tmp_path / "plain")
    trained, split = derender.load(tmp_path / "plain"), split_indices(pictures.files, plain.split, seed=0)
    shown, held_out = (torch.from_numpy(pictures.images[rows]) for rows in (split.train, split.validation))
    how = RefineConfig(whitening=plain.whitening, fitting=plain.fitting, refining={"images": 16})
    expected = distil(distil(trained, shown, held_out, how).model, shown, held_out, how).model.state_dict()
    for resume in (False, True):
        train(refined, pictures, tmp_path / "refined", resume=resume)
        ended = derender.load(tmp_path / "refined")
        assert ended.fitting and ended.whitening
        assert all(torch.equal(value, expected[name]) for name, value in ended.state_dict().items())
    assert any(not torch.equal(value, expected[name]) for name, value in trained.state_dict().items())
    with pytest.raises(ValueError, match=r"'refining': refining needs maps_only=false"):
        resolve("small", ["rounds=1", "maps_only=true"])


def test_a_distilled_decoder_is_left_behind(tmp_path):
    settings = resolve("small", [*NETWORK, "encoder=unet", "unet_width=4"]).model
    network = settings.network.model_copy(update={"unet_decoder": True})
    distilled = derender.Derenderer.seeded(settings.model_copy(update={"network": network}), seed=3)
    distilled.save(tmp_path / "distilled")
    config = resolve("small", BRIEF, start_from=str(tmp_path / "distilled"))
    begun = DerenderTask(config).build()
    assert begun.unet_decoder is None and config.model.network.encoder == "unet"
    weights = distilled.state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in begun.state_dict().items())
    with pytest.raises(ValueError, match="rendering trains none, derender unet distils one"):
        resolve("small", ["unet_decoder=true"])


def test_a_resumed_run_needs_the_start_no_more_and_ends_with_the_same_weights(given, pictures, tmp_path):
    whole_config = resolve("small", [*BRIEF, "images=32"], start_from=str(given))
    half_config = resolve("small", [*BRIEF, "images=16"], start_from=str(given))
    whole = train(whole_config, pictures, tmp_path / "whole")
    train(half_config, pictures, tmp_path / "half")
    shutil.rmtree(given)
    resumed = train(whole_config, pictures, tmp_path / "half", resume=True)
    assert resumed.images == whole.images == 32
    assert_same_weights(whole.folder, resumed.folder)


TINY = ["image_size=32", "width=8", "light_width=4", "code_size=16", "border_share=0.0625"]
SHORT = ["perceptual_weight=1", "self_features_steps=2", "batch_size=8", "checkpoint_every=16", "keep=last"]
SHORT += ["validate_every=16", "warmup_images=0", "images=32", "whitening.pictures=8", "examples=4"]
SHORT += ["final_rate=1"]


@pytest.fixture(scope="module")
def images() -> ImageSet:
    coarse = torch.rand(40, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    pixels = torch.nn.functional.interpolate(coarse, 64, mode="bilinear", align_corners=False)
    files = tuple(f"{i:03d}.png" for i in range(40))
    return ImageSet(images=(pixels * 255).byte().numpy(), files=files, source="made by the test")


@pytest.fixture(scope="module")
def start(tmp_path_factory, images):
    config = resolve("small", TINY)
    model = derender.Derenderer.seeded(config.model, seed=3).eval()
    small = avg_pool2d(torch.from_numpy(images.images).float() / 255, 2)
    how = with_changes(config.whitening, pictures=8, directions=6, gradients=True)
    whitening = fit_whitening(model, small, how, config.objective.perturb)
    return model.with_features(Features(whitening)).save(tmp_path_factory.mktemp("start") / "model")


def test_growth_keeps_scene_and_features(start, images):
    small = derender.load(start)
    whitening = small.whitening
    for size, places in ((64, 2), (128, 4)):
        config = resolve("small", [*SHORT, f"image_size={size}"], start_from=str(start))
        assert config.model.network.grown_from == 32 and config.maps_only
        grown = DerenderTask(config, whitening=whitening).build().eval()
        fine = torch.from_numpy(images.images[:2]).float() / 255
        fine = fine.repeat_interleave(size // 64, dim=-1).repeat_interleave(size // 64, dim=-2)
        coarse = avg_pool2d(fine, places)
        with torch.no_grad():
            for name, feature in small.embed(coarse).items():
                torch.testing.assert_close(grown.embed(fine)[name], feature, atol=1e-5, rtol=1e-5)
            scene, same = grown.decompose(fine), small.decompose(coarse)
            sizes = vars(grown.confidence(fine))
        assert sizes["photometric"].shape[-1] == size and sizes["perceptual"].shape[-1] == size // 4
        for own, other in ((scene.albedo, same.albedo), (scene.depth, same.depth)):
            own, other = avg_pool2d(own, 4 * places)[..., 1:-1], avg_pool2d(other, 4)[..., 1:-1]
            assert (own - other).abs().mean() < 0.25 * (other - other.mean()).abs().mean()
        torch.testing.assert_close(scene.camera, same.camera)


def test_a_grown_run_trains_maps_keeps_features_and_resumes_exactly(start, images, tmp_path):
    config = resolve("small", [*SHORT, "image_size=64", "deterministic=true"], start_from=str(start))
    train(config, images, tmp_path / "whole", accelerator="cpu")
    train(with_changes(config, images=16), images, tmp_path / "half", accelerator="cpu")
    train(config, images, tmp_path / "half", resume=True, accelerator="cpu")
    torch.use_deterministic_algorithms(False)
    small, whole, resumed = (derender.load(path) for path in (start, tmp_path / "whole", tmp_path / "half"))
    begun, ended, again = (model.state_dict() for model in (small, whole, resumed))
    assert all(torch.equal(ended[name], again[name]) for name in ended)
    for name, value in begun.items():
        fixed = "encoder" in name or "light" in name or "camera" in name
        assert torch.equal(ended[name], value) == (fixed and "confidence" not in name), name
    assert all(ended[name].any() for name in ended if ".growth." in name and "last" in name)
    assert whole.whitening is not None and small.whitening is not None and whole.fitting is not None
    for own, other in zip(whole.whitening.buffers(), small.whitening.buffers(), strict=True):
        torch.testing.assert_close(own, other)


def test_sizes_that_cannot_be_grown_from_and_settings_without_growth():
    for wrong in ({"grown_from": 64}, {"grown_from": 128}, {"grown_from": 48}):
        with pytest.raises(ValueError, match="grown_from must be an image size below 64"):
            NetworkSettings(**wrong)
    with pytest.raises(ValueError, match="and the encoder conv, got 64 and unet"):
        NetworkSettings(image_size=128, grown_from=64, encoder="unet")
    config = json.loads((derender.storage.places.PRETRAINED / "cars-64" / "config.json").read_text())
    assert NetworkSettings(**config["settings"]["network"]).doublings == 0
    model = derender.load("cars-64")
    assert not [name for name in model.state_dict() if ".growth." in name]


def test_curvature_of_the_same_surface_costs_the_same_after_growth():
    rows = torch.linspace(-1, 1, 32)
    bowl = 1 + 0.05 * (rows[:, None] ** 2 + rows**2)[None]
    finer = doubled(bowl[:, None], "smooth")[:, 0]
    inside = (..., slice(4, -4), slice(4, -4))
    large, small = (depth_smoothness(one[inside], order=2) for one in (finer, bowl))
    np.testing.assert_allclose(4 * large, small, rtol=0.02)
