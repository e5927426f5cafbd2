"""Features of a trained model: whitened ones move less with other factors; fitting has its own maps."""

import numpy as np
import pytest
import torch

import derender
from derender.data.synthetic import faces
from derender.evaluation.disentanglement.swap import swap_test
from derender.features.extract import model_fingerprint
from derender.interpretation.attribution import saliency
from derender.postprocess import Features
from derender.postprocess.embedding import HISTOGRAMS
from derender.postprocess.fitting import Fitting, FittingSettings, MorphableMaps, coordinates_of
from derender.scene.perturb import PerturbSettings
from derender.training.config import FeatureSettings, WhiteningSettings, with_changes
from derender.training.features import fit_whitening, make_features, make_fitting
from derender.training.views import BATCH_SIZE, photographs

SETTINGS = WhiteningSettings(pictures=80, views=2, directions=16, spatial=False)
CODES_OF_VECTORS = SETTINGS.model_copy(update={"vectors": False})
FITTING = FittingSettings(coordinates=12, steps=4, weight=0.5)


@pytest.fixture(scope="module")
def plain() -> derender.Derenderer:
    """A bundled model whose features are its codes."""
    return derender.load("rendered-faces-64").without_features()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.from_numpy(faces.generate(BATCH_SIZE + 1, image_size=64, seed=5).images)


def whitened(model, images, settings=SETTINGS, seed=0) -> derender.Derenderer:
    return model.with_features(Features(fit_whitening(model, images, settings, PerturbSettings(), seed=seed)))


@pytest.fixture(scope="module")
def white(plain, images) -> derender.Derenderer:
    return whitened(plain, images[:80])


@pytest.fixture(scope="module")
def fitted(images) -> derender.Derenderer:
    model = derender.load("rendered-faces-64")
    fitting = make_fitting(model, images[:24], FITTING)
    return model.with_features(Features(model.whitening, fitting))


def test_features_of_unseen_images_follow_other_factors_less_than_codes(plain, white, images):
    before, after = (swap_test(model, images[-32:].numpy()).moved for model in (plain, white))
    others = ~np.eye(4, dtype=bool)
    for place in range(4):
        assert after[others[:, place], place].mean() < 0.95 * before[others[:, place], place].mean()
    assert after[others].mean() < 0.85 * before[others].mean()
    for place in (2, 3):
        assert after[place, place] > 0.95 * before[place, place]


def test_light_and_camera_keep_their_codes_without_vectors(plain, white, images):
    model = whitened(plain, images[:80], CODES_OF_VECTORS)
    for name in ("geometry_map", "albedo_map"):
        assert torch.equal(model.whitening.get_buffer(name), white.whitening.get_buffer(name))
    with torch.no_grad():
        codes, features = model.encode(images[:4] / 255), model.embed(images[:4] / 255)
    assert all(torch.equal(features[name], codes[name]) for name in ("light", "camera"))


def test_a_last_batch_of_one_image_is_left_out_of_exchanges(plain, images):
    settings = SETTINGS.model_copy(update={"pictures": BATCH_SIZE + 1, "views": 1, "mirrored": False})
    result = fit_whitening(plain, images, settings, PerturbSettings())
    assert bool(result.get_buffer("camera_map").isfinite().all())


@pytest.mark.parametrize("mirrored", [True, False])
def test_a_mirror_image_has_the_features_of_the_image_where_both_are_read(
    plain, images, monkeypatch, tmp_path, mirrored
):
    monkeypatch.setattr("derender.networks.encoders.MAX_PLACES", 512)
    changes = {"mirrored": mirrored, "pictures": 16, "spatial": mirrored, "vectors": False}
    model = whitened(plain, images, SETTINGS.model_copy(update=changes))
    again = derender.load(model.save(tmp_path / "model"))
    some = images[:6].float() / 255
    with torch.no_grad():
        one, two, kept = model.embed(some), model.embed(some.flip(-1)), again.embed(some)
    for name in ("geometry", "albedo"):
        assert torch.allclose(one[name], two[name], atol=1e-4) is mirrored
        assert torch.equal(kept[name], one[name])
    assert not torch.allclose(one["camera"], two["camera"], atol=1e-2)


def test_fitted_coordinates_follow_the_feed_forward_features_with_the_set_length(fitted, images):
    some = images[:24].float() / 255
    features, activations = fitted.embed(some), fitted.activations(some)
    plain = fitted.with_features(fitted.features.with_steps(0)).embed(some)
    squares = {"plain": 0.0, "fitted": 0.0}
    for name in ("geometry", "albedo"):
        size = plain[name].shape[1]
        assert torch.equal(features[name][:, :size], plain[name])
        expected = fitted.fitting.features(activations[coordinates_of(name)])
        assert torch.equal(features[name][:, size:], expected) and expected.shape == (24, 12)
        squares["plain"] += float(plain[name].square().sum())
        squares["fitted"] += float(expected.square().sum())
    assert all(torch.equal(features[name], plain[name]) for name in ("light", "camera"))
    assert (squares["fitted"] / squares["plain"]) ** 0.5 == pytest.approx(0.5, rel=0.01)


def test_steps_are_part_of_the_fingerprint_and_fitting_is_saved(fitted, images, tmp_path):
    before, other = model_fingerprint(fitted), fitted.with_features(fitted.features.with_steps(7))
    assert model_fingerprint(other) != before
    assert model_fingerprint(other.with_features(other.features.with_steps(4))) == before
    again = derender.load(fitted.save(tmp_path / "fitted"))
    one, two = fitted.embed(images[:2].float() / 255), again.embed(images[:2].float() / 255)
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_maps_of_another_size_are_refused_when_a_model_is_loaded(tmp_path):
    small = derender.Derenderer.from_preset("small", image_size=32, width=8, light_width=4, code_size=16)
    maps = {"depth": torch.rand(4, 64, 64), "albedo": torch.rand(4, 3, 64, 64)}
    fitting = Fitting(MorphableMaps.of(maps, 2), FittingSettings())
    small.with_features(Features(fitting=fitting)).save(tmp_path / "small")
    with pytest.raises(ValueError, match=r"is damaged \(it fits depth of \(64, 64\)"):
        derender.load(tmp_path / "small")
    with pytest.raises(ValueError, match="derender whiten --model"):
        small.fit_scenes(torch.rand(1, 3, 32, 32))


def test_a_feature_keeps_its_size(plain, images):
    few = ("pictures=16", "views=1", "spatial=false", "directions=8", "vectors=false")
    changes = (*few, "examples=16", "coordinates=12", "steps=2")
    model = make_features(plain, images[:24], with_changes(FeatureSettings(), changes))
    features = model.embed(images[:3].float() / 255)
    assert {name: value.shape for name, value in features.items()} == dict.fromkeys(features, (3, 256))
    assert float(features["geometry"][:, -12:].abs().sum()) > 0


def test_what_makes_no_sense_is_named(plain, images):
    none_left = {("coordinates=256", "steps=1"): "leave none of a feature's 256"}
    for changes, message in {**none_left, ("steps=-1",): "fitting.steps"}.items():
        with pytest.raises(ValueError, match=message):
            make_features(plain, images, with_changes(FeatureSettings(), ("pictures=4", *changes)))
    with pytest.raises(ValueError, match="at least 2 images, got 1"):
        make_fitting(plain, images[:1], FittingSettings())
    broken = derender.load("rendered-faces-64")
    next(broken.nets["albedo"].decoder.parameters()).data.fill_(float("nan"))
    with pytest.raises(ValueError, match="fitting: NaN or infinity in albedo of images 0"):
        make_fitting(broken, images[:4], FittingSettings())


def test_views_that_keep_the_images_own_pixels(plain, images):
    grain = torch.randn(6, 1, 32, 32, generator=torch.Generator().manual_seed(0)).repeat_interleave(2, 2)
    batch = (images[:6] / 255 + 0.1 * grain.repeat_interleave(2, 3)).clamp(0, 1)  # finer than renderings
    scene = plain.decompose(batch)
    shown = photographs(plain, scene, batch, torch.Generator().manual_seed(3), 2)
    again = photographs(plain, scene, batch, torch.Generator().manual_seed(3), 2)
    assert len(shown) == 3 and torch.equal(shown[0], batch) and torch.equal(shown[1], again[1])
    assert all(one.min() >= 0 and one.max() <= 1 for one in shown)
    edges = [one.mean(dim=1).diff(dim=-1).abs().mean() for one in (*shown, plain.render(scene).image)]
    assert min(edges[1:3]) > max(0.6 * edges[0], 1.3 * edges[3])
    assert not torch.allclose(shown[1], shown[2], atol=0.05)


def test_gradients_beside_activations_are_kept_with_the_model(tmp_path, monkeypatch):
    monkeypatch.setattr("derender.postprocess.embedding.CELLS", 4)
    model = derender.Derenderer.from_preset("small", seed=0, image_size=32)
    pixels = torch.from_numpy(faces.generate(24, image_size=32, seed=5).images).float() / 255
    settings = WhiteningSettings(pictures=24, views=2, gradients=True, photographs=True)
    model = whitened(model, pixels, settings).eval()
    own = model.without_features().factor_activations("albedo", pixels[:2]).shape[1]
    assert model.whitening.size("albedo") == own + 2 * 4 * 4 + HISTOGRAMS
    assert model.whitening.size("geometry") == own
    model.save(tmp_path / "model")
    result, expected = derender.load(tmp_path / "model").embed(pixels), model.embed(pixels)
    for name, value in expected.items():
        torch.testing.assert_close(result[name], value)
    blank = model.whitening.get_buffer("albedo_map").clone()
    blank[own:] = 0
    model.whitening.get_buffer("albedo_map").copy_(blank)
    assert not torch.allclose(model.embed(pixels)["albedo"], expected["albedo"], atol=1e-3)


def test_the_canonical_view_of_turned_heads_differs_less_than_they_do(plain, images):
    scene = plain.decompose(images[:16].float() / 255)
    turned = [scene.camera + torch.tensor([0, side * 0.25, 0, 0, 0, 0]) for side in (-1, 1)]
    shown = [plain.render(scene.with_parameters(camera=camera)).image for camera in turned]
    frontal = [plain.canonical_view(one) for one in shown]
    apart, left = ((one - other)[..., 16:-16, 16:-16].abs().mean() for one, other in (shown, frontal))
    assert left < 0.6 * apart


def test_geometry_of_the_canonical_view_is_kept_with_the_model(plain, images, tmp_path, monkeypatch):
    monkeypatch.setattr("derender.networks.encoders.MAX_PLACES", 512)  # whitening takes their cube
    settings = WhiteningSettings(pictures=12, views=2, directions=8, photographs=True, canonical=True)
    model, pixels = whitened(plain, images[:12], settings), images[:6].float() / 255
    turned = plain.factor_activations("geometry", plain.canonical_view(pixels))
    assert model.whitening.canonical == {"geometry"}
    activations = model.activations(pixels)
    assert model.activations(1.2 * pixels)["geometry"].isfinite().all(), "renderings may be too bright"
    torch.testing.assert_close(model.codes(activations)["geometry"], plain.encode(pixels)["geometry"])
    _, own, _, mirrored = activations["geometry"].split([256, turned.shape[1]] * 2, dim=1)
    torch.testing.assert_close(own, turned)
    expected = ((own + mirrored) / 2 - model.whitening.geometry_mean) @ model.whitening.geometry_map
    torch.testing.assert_close(model.embed(pixels)["geometry"], expected, rtol=1e-3, atol=1e-4)
    model.save(tmp_path / "model")
    again = derender.load(tmp_path / "model")
    for name, value in model.embed(pixels).items():
        torch.testing.assert_close(again.embed(pixels)[name], value)
    maps = [saliency(method, model, pixels, "geometry") for method in ("grad-cam", "pixels")]
    assert [one.shape for one in maps] == [(6, 4, 4), (6, 64, 64)] and all(one.amax() > 0 for one in maps)
    codes = settings.model_copy(update={"spatial": False})
    assert whitened(plain, images[:12], codes).whitening.canonical == set()


def test_features_of_framed_images_are_kept_with_the_model(plain, images, tmp_path, monkeypatch):
    monkeypatch.setattr("derender.networks.encoders.MAX_PLACES", 512)
    monkeypatch.setattr("derender.training.framing.BATCH", 16)
    monkeypatch.setattr("derender.postprocess.framing.DOUBT", 0.0)  # every image is moved
    settings = WhiteningSettings(pictures=12, views=2, directions=8, photographs=True, canonical=True)
    settings = settings.model_copy(update={"framing": 32})
    model, pixels = whitened(plain, images[:12], settings), images[:4].float() / 255
    framed = model.whitening.framing(pixels)
    assert not torch.allclose(framed, pixels, atol=0.05) and model.whitening.moved == {"geometry", "albedo"}
    activations = model.activations(pixels)
    for name, code in plain.encode(pixels).items():
        torch.testing.assert_close(model.codes(activations)[name], code)
    own = plain.factor_activations("albedo", framed)
    taken = model.whitening.inputs("albedo", activations["albedo"])
    mirrored = plain.factor_activations("albedo", framed.flip(-1))
    torch.testing.assert_close(taken, (own + mirrored) / 2, rtol=1e-3, atol=1e-4)
    again = derender.load(model.save(tmp_path / "model"))
    kept = whitened(again, images[:12], settings)
    for name, value in model.embed(pixels).items():
        torch.testing.assert_close(again.embed(pixels)[name], value)
        torch.testing.assert_close(kept.embed(pixels)[name], value)
    seen = saliency("grad-cam", model, pixels, "albedo")
    assert seen.shape == (4, 4, 4) and seen.amax() > 0
