"""What lets a trained model fit scenes: made of its own maps, saved with it, part of features when asked."""

import pytest
import torch

import derender
from derender.data.synthetic import faces
from derender.features.extract import model_fingerprint
from derender.postprocess import Features
from derender.postprocess.fitting import Fitting, FittingSettings, coordinates_of
from derender.postprocess.morphable import MorphableMaps
from derender.storage.folder import FITTING_FILE
from derender.training.config import FeatureSettings, with_changes
from derender.training.features import make_features, make_fitting


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.from_numpy(faces.generate(24, image_size=64, seed=5).images)


@pytest.fixture(scope="module")
def fitting(images):
    model = derender.load("rendered-faces-64")
    return make_fitting(model, images, FittingSettings(coordinates=12, steps=6, weight=0.5))


@pytest.fixture
def model(fitting) -> derender.Derenderer:
    model = derender.load("rendered-faces-64")
    return model.with_features(Features(model.whitening, fitting))


def test_the_rendering_comes_nearer_to_the_picture(model, images):
    pictures = images[:8].float() / 255
    found = model.fit_scenes(pictures, 20)
    assert found.after.mean() < 0.9 * found.before.mean()
    read, fitted = (model.render(scene) for scene in (model.decompose(pictures), found.scene))
    both = (read.mask * fitted.mask)[:, None]
    apart = [((made.image - pictures).abs() * both).sum() / both.sum() for made in (read, fitted)]
    assert both.mean() > 0.5
    assert apart[1] < 0.9 * apart[0]


def test_light_and_camera_stay_where_something_is_seen(model, monkeypatch):
    for rate in ("_LIGHT_RATE", "_ROTATION_RATE", "_TRANSLATION_RATE"):
        monkeypatch.setattr(f"derender.postprocess.fitting.{rate}", 1.0)
    scene = model.fit_scenes(torch.rand(4, 3, 64, 64, generator=torch.Generator().manual_seed(0)), 8).scene
    assert scene.light[:, :2].min() >= 0.02 and scene.light[:, :2].max() <= 1.2
    assert scene.light[:, 2:].abs().rad2deg().max() <= 80.001
    assert scene.camera[:, :3].abs().rad2deg().max() <= 75.001
    assert scene.camera[:, 3:].abs().max() == pytest.approx(0.4)  # held there, and no further


def test_fitted_coordinates_follow_what_is_read(model, images):
    pictures = images[:4].float() / 255
    fitted, activations = model.embed(pictures), model.activations(pictures)
    read = model.with_features(model.features.with_steps(0)).embed(pictures)
    for name in ("geometry", "albedo"):
        size = read[name].shape[1]
        assert torch.equal(fitted[name][:, :size], read[name])
        expected = model.fitting.features(activations[coordinates_of(name)])
        assert torch.equal(fitted[name][:, size:], expected) and expected.shape == (4, 12)
    for name in ("light", "camera"):
        assert torch.equal(fitted[name], read[name])
    assert set(model.codes(activations)) == {"geometry", "albedo", "light", "camera"}


def test_weight_is_the_length_of_fitted_coordinates_beside_what_is_read(model, images):
    features = model.embed(images.float() / 255)
    squares = {"read": 0.0, "fitted": 0.0}
    for name in ("geometry", "albedo"):
        squares["fitted"] += float(features[name][:, -12:].square().sum())
        squares["read"] += float(features[name][:, :-12].square().sum())
    assert (squares["fitted"] / squares["read"]) ** 0.5 == pytest.approx(0.5, rel=0.01)


def test_steps_are_part_of_the_fingerprint(model):
    before = model_fingerprint(model)
    other = model.with_features(model.features.with_steps(7))
    assert model_fingerprint(other) != before
    assert model_fingerprint(other.with_features(other.features.with_steps(6))) == before


def test_saved_with_the_model(model, images, tmp_path):
    model.save(tmp_path / "fitted")
    again = derender.load(tmp_path / "fitted")
    pictures = images[:2].float() / 255
    one, two = model.embed(pictures), again.embed(pictures)
    assert all(torch.equal(one[name], two[name]) for name in one)
    (tmp_path / "fitted" / FITTING_FILE).write_bytes(b"{}")
    with pytest.raises(ValueError, match="is damaged"):
        derender.load(tmp_path / "fitted")


def test_maps_of_another_size_are_refused_when_a_model_is_loaded(tmp_path):
    small = derender.Derenderer.from_preset("small", image_size=32, width=8, light_width=4, code_size=16)
    maps = {"depth": torch.rand(4, 64, 64), "albedo": torch.rand(4, 3, 64, 64)}
    fitting = Fitting(MorphableMaps.of(maps, 2), FittingSettings())
    small.with_features(Features(fitting=fitting)).save(tmp_path / "small")
    with pytest.raises(ValueError, match=r"is damaged \(it fits depth of \(64, 64\)"):
        derender.load(tmp_path / "small")


def test_a_model_without_it_says_how_to_get_it(images):
    model = derender.Derenderer.from_preset("small", image_size=32, width=8, light_width=4, code_size=16)
    with pytest.raises(ValueError, match="derender whiten --model"):
        model.fit_scenes(torch.rand(1, 3, 32, 32))


def test_a_feature_keeps_its_size(images):
    model = derender.load("rendered-faces-64")
    changes = (
        "pictures=16",
        "views=1",
        "spatial=false",
        "directions=8",
        "examples=16",
        "coordinates=12",
        "steps=2",
    )
    model = make_features(model, images, with_changes(FeatureSettings(), changes))
    features = model.embed(images[:3].float() / 255)
    assert {name: value.shape for name, value in features.items()} == dict.fromkeys(features, (3, 256))
    assert float(features["geometry"][:, -12:].abs().sum()) > 0


def test_what_is_made_does_not_depend_on_what_was_there(model, images):
    settings = FittingSettings(coordinates=12, steps=6, weight=0.5)
    again = make_fitting(model, images, settings)
    for name, value in model.fitting.tensors().items():
        torch.testing.assert_close(again.tensors()[name], value)
    assert model.fitting is not again


@pytest.mark.parametrize(
    ("changes", "said"),
    [(("coordinates=256", "steps=1"), "leave none of a feature's 256"), (("steps=-1",), "fitting.steps")],
)
def test_settings_that_make_no_sense(images, changes, said):
    with pytest.raises(ValueError, match=said):
        make_features(
            derender.load("rendered-faces-64"),
            images,
            with_changes(FeatureSettings(), ("pictures=4", *changes)),
        )


def test_one_picture_is_too_few(images):
    with pytest.raises(ValueError, match="at least 2 images, got 1"):
        make_fitting(derender.load("rendered-faces-64"), images[:1], FittingSettings())


def test_maps_that_are_no_numbers_are_named(images):
    model = derender.load("rendered-faces-64")
    with torch.no_grad():
        next(model.nets["albedo"].decoder.parameters()).fill_(float("nan"))
    with pytest.raises(ValueError, match="fitting: NaN or infinity in albedo of images 0"):
        make_fitting(model, images, FittingSettings())
