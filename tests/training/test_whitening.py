"""Whitening a trained model: features move less with light and camera than codes, and are saved with it."""

import numpy as np
import pytest
import torch

import derender
from derender.data import PictureSet
from derender.data.synthetic import faces
from derender.evaluation.disentanglement.swap import swap_test
from derender.features.extract import model_fingerprint
from derender.postprocess import Features
from derender.postprocess.whitening import Whitening
from derender.scene.perturb import PerturbSettings
from derender.storage.folder import WHITENING_FILE
from derender.training import resolve, train
from derender.training.config import WhiteningSettings
from derender.training.features import BATCH_SIZE, fit_whitening

WITH_PLACES = WhiteningSettings(pictures=200, views=3, directions=16, vectors=False)
SETTINGS = WITH_PLACES.model_copy(update={"spatial": False})  # of codes alone, which is much quicker
WITH_VECTORS = SETTINGS.model_copy(update={"vectors": True, "views": 2})
TINY = ["image_size=32", "width=8", "light_width=4", "code_size=16", "perceptual=none", "batch_size=8"]
TINY += ["images=16", "warmup_images=0"]


def read_only(name: str = "rendered-faces-64") -> derender.Derenderer:
    """A bundled model, its features made of what its encoders say alone."""
    model = derender.load(name)
    return model.with_features(Features(model.whitening))


def whitened(model: derender.Derenderer, whitening: Whitening) -> derender.Derenderer:
    return model.with_features(Features(whitening))


@pytest.fixture(scope="module")
def model() -> derender.Derenderer:
    return read_only()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.from_numpy(faces.generate(264, image_size=64, seed=5).images)


def moved_by_light(model, images) -> dict[str, float]:
    """How far features move when the light is exchanged, over how far apart two pictures are."""
    with torch.no_grad():
        scene = model.decompose(images.float() / 255)
        other = scene.with_parameters(light=scene.light.roll(1, dims=0))
        one, two = model.embed(model.render(scene).image), model.embed(model.render(other).image)
    return {
        name: float(
            (one[name] - two[name]).norm(dim=1).mean() / (one[name] - one[name].roll(1, 0)).norm(dim=1).mean()
        )
        for name in ("geometry", "albedo")
    }


def test_light_moves_features_less_than_codes_on_pictures_that_were_not_seen(images):
    model = read_only("faces-64")  # codes of albedo of the other follow light little as they are
    model = model.without_features()
    before = moved_by_light(model, images[200:])
    model = whitened(model, fit_whitening(model, images[:200], WITH_PLACES, PerturbSettings(), seed=1))
    after = moved_by_light(model, images[200:])
    assert after["geometry"] < 0.9 * before["geometry"]
    assert after["albedo"] < 0.9 * before["albedo"]


def test_scenes_are_those_of_the_codes(images):
    model = read_only()
    model = whitened(model, fit_whitening(model, images[:50], WITH_VECTORS, PerturbSettings()))
    pictures = images[:4].float() / 255
    with torch.no_grad():
        codes, features = model.encode(pictures), model.embed(pictures)
        assert torch.equal(model.decompose(pictures).depth, model.decode(codes).depth)
    for name, feature in features.items():
        assert feature.shape == codes[name].shape
        assert not torch.allclose(feature, codes[name])


def test_light_and_camera_keep_their_codes_where_that_is_asked_for(images):
    model = read_only()
    settings = WITH_VECTORS.model_copy(update={"vectors": False})
    others = fit_whitening(model, images[:50], WITH_VECTORS, PerturbSettings())
    model = whitened(model, fit_whitening(model, images[:50], settings, PerturbSettings()))
    for name in ("geometry_map", "albedo_map"):
        assert torch.equal(model.whitening.get_buffer(name), others.get_buffer(name))
    with torch.no_grad():
        codes, features = model.encode(images[:4] / 255), model.embed(images[:4] / 255)
    assert torch.equal(features["light"], codes["light"])
    assert torch.equal(features["camera"], codes["camera"])


def test_light_and_camera_follow_other_factors_less_than_codes_on_pictures_that_were_not_seen(images):
    model = read_only()
    model = model.without_features()
    before = swap_test(model, images[-32:].numpy()).moved
    model = whitened(model, fit_whitening(model, images[:128], WITH_VECTORS, PerturbSettings(), seed=1))
    after = swap_test(model, images[-32:].numpy()).moved
    for place in (2, 3):
        others = np.arange(4) != place
        assert after[others, place].mean() < 0.8 * before[others, place].mean()
        assert after[place, place] > 0.95 * before[place, place]


def test_a_batch_of_one_picture_has_nobody_to_exchange_with(images):
    model = read_only()
    settings = WITH_VECTORS.model_copy(update={"views": 1})
    found = fit_whitening(model, images[: BATCH_SIZE + 1], settings, PerturbSettings())
    assert bool(found.get_buffer("camera_map").isfinite().all())


def test_a_mirror_image_has_the_features_of_the_picture_unless_told_otherwise(images, tmp_path):
    model = read_only()
    pictures = images[:6].float() / 255
    for mirrored in (True, False):
        settings = WITH_PLACES.model_copy(update={"mirrored": mirrored, "pictures": 40, "spatial": mirrored})
        model = whitened(model, fit_whitening(model, images, settings, PerturbSettings()))
        again = derender.load(model.save(tmp_path / str(mirrored)))
        with torch.no_grad():
            one, two, kept = model.embed(pictures), model.embed(pictures.flip(-1)), again.embed(pictures)
        for name in ("geometry", "albedo"):
            assert torch.allclose(one[name], two[name], atol=1e-4) is mirrored
            assert torch.equal(kept[name], one[name])
        assert not torch.allclose(one["camera"], two["camera"], atol=1e-2)


def test_fitting_anew_does_not_depend_on_the_features_there_were(images):
    model = read_only()
    found = []
    for _ in range(2):
        model = whitened(model, fit_whitening(model, images[:30], SETTINGS, PerturbSettings()))
        found.append(model.whitening.get_buffer("albedo_map"))
    assert torch.equal(*found)


def test_the_same_seed_gives_the_same_features(model, images):
    one, two, other = (
        fit_whitening(model, images[:60], SETTINGS, PerturbSettings(), seed=seed) for seed in (0, 0, 1)
    )
    assert torch.equal(one.get_buffer("geometry_map"), two.get_buffer("geometry_map"))
    assert not torch.equal(one.get_buffer("geometry_map"), other.get_buffer("geometry_map"))


@pytest.fixture(scope="module")
def pictures() -> PictureSet:
    made = np.random.default_rng(0).integers(0, 256, (40, 3, 32, 32), dtype=np.uint8)
    return PictureSet(images=made, files=tuple(f"{i:03d}.png" for i in range(40)), source="made by the test")


def test_a_run_ends_with_features_whitened_unless_told_not_to(pictures, tmp_path):
    phases = []
    run = train(resolve("small", TINY), pictures, tmp_path / "a", progress=lambda p: phases.append(p.phase))
    assert phases[-1] == "features"
    model = derender.load(run.folder)
    assert model.whitening is not None
    saved = derender.load(model.save(tmp_path / "copy"))
    assert torch.equal(saved.whitening.get_buffer("albedo_map"), model.whitening.get_buffer("albedo_map"))
    plain = train(resolve("small", [*TINY, "whitening.pictures=0"]), pictures, tmp_path / "b")
    assert not (plain.folder / "model" / WHITENING_FILE).exists()
    assert derender.load(plain.folder).whitening is None


def test_a_table_knows_whether_its_features_were_whitened(images):
    model = read_only()
    model = model.without_features()
    before = model_fingerprint(model)
    model = whitened(model, fit_whitening(model, images[:20], SETTINGS, PerturbSettings()))
    assert model_fingerprint(model) != before


def test_damaged_whitening_is_named(model, tmp_path):
    folder = model.save(tmp_path / "model")
    (folder / WHITENING_FILE).write_bytes(b"not a safetensors file")
    with pytest.raises(ValueError, match="is damaged"):
        derender.load(folder)
