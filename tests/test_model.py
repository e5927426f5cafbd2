"""Derenderer: the Python contract, saving and loading, and a fifth factor added from outside."""

import json
import math
import pickle
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

import derender
from derender.data import check_images
from derender.model import Derenderer, load
from derender.networks import FACTORS, Factor
from derender.networks.encoders import activations
from derender.networks.factors import vector_net
from derender.postprocess import Features
from derender.postprocess.whitening import Projection, Whitening
from derender.presets import ModelSettings
from derender.render import Rendering, render_scene
from derender.scene import Scene
from derender.storage.places import CONFIG_FILE, PRETRAINED, WEIGHTS_FILE, bundled_models
from derender.training.config import ObjectiveSettings
from derender.training.step import training_step


@pytest.fixture(scope="module")
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8).eval()


@pytest.fixture
def images(generator) -> torch.Tensor:
    return torch.rand(3, 3, 32, 32, generator=generator)


def test_decompose_gives_a_scene_in_range(model, images):
    scene = model.decompose(images)
    assert isinstance(scene, Scene)
    assert scene.depth.shape == (3, 32, 32)
    assert scene.depth.min() >= 0.9 and scene.depth.max() <= 1.1
    assert scene.albedo.min() >= 0 and scene.albedo.max() <= 1
    assert scene.light[:, :2].min() >= 0 and scene.light[:, :2].max() <= 1
    assert scene.light[:, 2:].abs().max() <= math.pi / 4
    assert scene.camera[:, :3].abs().max() <= math.pi / 3
    assert (scene.camera[:, 5] == 0).all()


def test_half_precision_images_and_pickled_models_give_the_scene(model, images):
    expected = model.decompose(images.half().float()).depth
    assert torch.equal(model.decompose(images.half()).depth, expected)
    assert torch.equal(pickle.loads(pickle.dumps(model)).decompose(images.half()).depth, expected)
    assert model.decompose(images.bfloat16()).depth.dtype == torch.float32


def test_render_of_decompose_is_reconstruct(model, images):
    first, second = model.render(model.decompose(images)), model.reconstruct(images)
    torch.testing.assert_close(first.image, second.image)
    assert first.image.shape == (3, 3, 32, 32)
    assert first.depth.shape == first.mask.shape == (3, 32, 32)


def test_activations_begin_with_the_code_and_end_with_the_spatial_map(model, images):
    result = model.activations(images)
    codes = model.encode(images)
    for name, code in model.codes(result).items():
        torch.testing.assert_close(code, codes[name])
        torch.testing.assert_close(model.features_from(result)[name], codes[name])  # nothing was fitted yet
        places = model.nets[name].encoder.spatial(images)
        torch.testing.assert_close(result[name][:, code.shape[1] :], places.flatten(1))


def test_features_are_exchanged_in_a_model_that_shares_the_weights(model, images):
    maps = {"geometry": Projection(torch.zeros(256), 2 * torch.eye(256), torch.ones(256))}
    whitened = model.with_features(Features(Whitening(maps)))
    assert model.whitening is None and whitened.whitening is not None and not whitened.features.fits_scenes
    codes, features = model.embed(images), whitened.embed(images)
    torch.testing.assert_close(features["geometry"], 2 * codes["geometry"])
    torch.testing.assert_close(features["light"], codes["light"])
    torch.testing.assert_close(whitened.without_features().embed(images)["geometry"], codes["geometry"])
    assert all(a is b for a, b in zip(model.parameters(), whitened.parameters(), strict=True))


def test_nothing_but_with_features_sets_the_parts_of_features():
    package = Path(derender.__file__).parent
    setting = re.compile(r"\.(whitening|fitting)(, \S+)? = ")
    where = [file.name for file in package.rglob("*.py") if setting.search(file.read_text())]
    assert where == ["embedding.py"]


def test_many_channels_are_averaged_over_places():
    places = torch.arange(2 * 300 * 16.0).reshape(2, 300, 4, 4)
    result = activations(torch.zeros(2, 5), places)
    assert result.shape == (2, 5 + 300 * 4)
    assert result[0, 5] == places[0, 0, :2, :2].mean()
    assert activations(torch.zeros(2, 5), places[:, :128]).shape == (2, 5 + 128 * 16)


def test_each_feature_decides_its_own_parameter_only(model, images):
    codes = model.embed(images)
    assert list(codes) == ["geometry", "albedo", "light", "camera"]
    assert all(code.shape == (3, 256) for code in codes.values())
    before, after = model.decode(codes), model.decode({**codes, "light": codes["light"].flip(0)})
    torch.testing.assert_close(after.light, before.light.flip(0))
    for name in ("depth", "albedo", "camera"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        ((2, 3, 64, 64), torch.float32, r"takes images of shape \(N, 3, 32, 32\), got \(2, 3, 64, 64\)"),
        ((3, 32, 32), torch.float32, r"got \(3, 32, 32\)"),
        ((2, 3, 32, 32), torch.uint8, "divide uint8 by 255"),
    ],
)
def test_wrong_pictures_are_named(model, shape, dtype, message):
    with pytest.raises(ValueError, match=message):
        check_images(torch.zeros(shape, dtype=dtype), model.image_size)


def test_same_seed_same_weights_and_the_global_generator_is_left_alone():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    one, two, other = (Derenderer.from_preset("small", seed=seed, width=8) for seed in (1, 1, 2))
    torch.testing.assert_close(torch.rand(3), expected)
    weights = [model.nets["geometry"].encoder.to_code[0].weight for model in (one, two, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(ValueError, match=r"'smal'.*did you mean 'small'"):
        Derenderer.from_preset("smal")


def test_saved_and_loaded_models_agree(model, images, tmp_path):
    folder = model.save(tmp_path / "m")
    loaded = load(folder, device="auto").to("cpu")
    assert loaded.settings == model.settings
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    for name, feature in loaded.embed(images).items():
        assert torch.equal(feature, model.embed(images)[name])


def test_a_run_folder_is_loaded_by_its_model_and_nothing_is_overwritten_unasked(model, tmp_path):
    saved = model.save(tmp_path / "run" / "model")
    assert derender.load(str(tmp_path / "run")).image_size == 32
    with pytest.raises(FileExistsError, match="choose another folder"):
        model.save(saved)
    model.save(saved, overwrite=True)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["model"]


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("nothing", "give a run folder, a saved folder, a Hub id"),
        ("", "holds no model"),
        ("rendered-faces-65", "come with derender .*rendered-faces-64"),
    ],
)
def test_a_missing_model_says_what_to_give(tmp_path, place, message):
    with pytest.raises(FileNotFoundError, match=message):
        load(tmp_path / place if place != "rendered-faces-65" else place)


def _truncated(folder: Path) -> None:
    data = (folder / WEIGHTS_FILE).read_bytes()
    (folder / WEIGHTS_FILE).write_bytes(data[: len(data) // 2])


def _with_config(change):
    def damage(folder: Path) -> None:
        file = folder / CONFIG_FILE
        file.write_text(change(file.read_text()))

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_truncated, "damaged"),
        (_with_config(lambda text: "{"), "damaged"),
        (_with_config(lambda text: json.dumps({**json.loads(text), "format": 99})), "format 99.*update der"),
        (_with_config(lambda text: text.replace('"ranges": {', '"ranges": {"fov": 3, ')), "damaged"),
    ],
)
def test_damaged_models_are_refused_with_one_sentence(model, tmp_path, damage, message):
    folder = model.save(tmp_path / "m")
    damage(folder)
    with pytest.raises(ValueError, match=message) as caught:
        load(folder)
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Shine:
    """A renderer that adds the fifth factor's strength to every covered pixel."""

    def __call__(self, scene: Scene, fov_deg: float) -> Rendering:
        plain = render_scene(scene, fov_deg)
        strength = scene.extra["highlight"][:, :, None, None]
        return Rendering(plain.image + strength * plain.mask[:, None], plain.depth, plain.mask)


HIGHLIGHT = Factor(
    name="highlight", parameter="highlight", build=vector_net(1), mirrored=False,
    to_parameter=lambda raw, ranges: raw.float() / 2 + 0.5,
    perturb=lambda value, generator, settings, ranges: torch.rand(value.shape, generator=generator),
)  # fmt: skip


def test_a_fifth_factor_trains_embeds_and_is_perturbed_without_touching_anything_else(images, tmp_path):
    settings = ModelSettings(network=Derenderer.from_preset("small", image_size=32, width=8).settings.network)
    rows = {"factors": (*FACTORS, HIGHLIGHT), "renderer": Shine()}
    model = Derenderer.seeded(settings, 0, **rows)
    assert model.embed(images)["highlight"].shape == (3, 256)
    objective = ObjectiveSettings(perceptual="none", loocc="all")
    model.zero_grad()
    training_step(model, images, objective, None, torch.Generator().manual_seed(0)).total.backward()
    gradients = [parameter.grad for parameter in model.nets["highlight"].parameters()]
    assert all(gradient is not None and gradient.abs().sum() > 0 for gradient in gradients)
    folder = model.save(tmp_path / "five")
    assert "highlight" in load(folder, **rows).embed(images)
    with pytest.raises(ValueError, match="pass its rows as factors="):
        load(folder)


def test_every_bundled_model_loads_by_name_and_has_a_card(generator):
    assert "rendered-faces-64" in bundled_models()
    for name in bundled_models():
        model = derender.load(name)
        assert not model.training
        assert all(value.dtype == torch.float32 for value in model.parameters())
        size = model.image_size
        result = model.reconstruct(torch.rand(2, 3, size, size, generator=generator))
        assert result.image.isfinite().all()
        card = (PRETRAINED / name / "README.md").read_text()
        assert "**Trained on**" in card
        assert "**Known failures.**" in card
        assert (PRETRAINED / name / "model.safetensors").stat().st_size <= 12 << 20
