"""Encoders that learn what fitting finds: what they come nearer to, what stays, what is refused."""

import pytest
import torch

import derender
from derender.data.synthetic import faces
from derender.data.synthetic.settings import EffectSettings, FaceSettings
from derender.model import Derenderer
from derender.objectives.reconstruction import masked_l1
from derender.render import Rendering
from derender.scene import Scene
from derender.scene.crop import CropSettings, crop_images
from derender.training import distillation
from derender.training.config import FeatureSettings
from derender.training.features import make_features

FRAMES = CropSettings(nearer=1.15, farther=1.9, shift=0.25)
LESSONS = distillation.RefiningSettings(
    images=192, batch_size=8, learning_rate=5e-4, fit_steps=4, rendered=0.25, worst=0, picture_weight=0
)
FEW = {"pictures": 16, "views": 2, "directions": 8, "spatial": False}
PARTS = {"refining": LESSONS.model_dump(), "whitening": FEW, "fitting": {"examples": 16}}
SHORT = distillation.RefineConfig.model_validate(PARTS)
NONE = SHORT.whitening.model_copy(update={"pictures": 0})


def untrained(renderer: str, count: int) -> tuple[Derenderer, torch.Tensor]:
    """A small model that can fit scenes, and so many images of its 32 pixels."""
    images = torch.from_numpy(faces.generate(count, image_size=32, seed=9).images)
    settings = {"whitening": {"pictures": 0}, "fitting": {"examples": count, "coordinates": 4}}
    sizes = {"image_size": 32, "width": 8, "light_width": 8}
    start = Derenderer.from_preset("small", seed=0, renderer=renderer, **sizes).eval().requires_grad_(False)
    how = SHORT.model_copy(update=FeatureSettings(**settings).__dict__)
    return make_features(start, images, how), images


def changed(**refining) -> distillation.RefineConfig:
    return SHORT.model_copy(update={"refining": LESSONS.model_copy(update=refining)})


@pytest.fixture(scope="module")
def model():
    return derender.load("rendered-faces-64")


@pytest.fixture(scope="module")
def images():
    effects = EffectSettings(gloss=(0.3, 0.5), shadows=True, lamps=3)  # none of which the model has seen
    return torch.from_numpy(faces.generate(16, 64, seed=9, settings=FaceSettings(effects=effects)).images)


@pytest.fixture(scope="module")
def refined(model, images):
    """Taught by few images of a kind the model does not know, and measured on the same."""
    lessons = changed(images=120, batch_size=4, learning_rate=2e-4)
    return distillation.refine(model, images[:8], images[:8], lessons, seed=5)


@pytest.fixture(scope="module")
def meant(model, images) -> Scene:
    """Scenes fitted to the images."""
    return distillation.fit_scenes(model, images, 2, print).scene(model.fitting.maps)


def test_what_is_read_comes_nearer_to_what_fitting_finds(refined):
    for name in ("depth", "albedo", "light", "camera"):
        assert refined.gaps[name]["now"] < 0.8 * refined.gaps[name]["before"], name
    assert refined.errors["fitted"] < refined.errors["now"] < refined.errors["before"]


def test_the_same_seed_distils_the_same_and_nothing_else_is_touched():
    model, few = untrained("phong", 8)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    state = torch.random.get_rng_state()
    one, again = (distillation.refine(model, few, few, changed(images=16), seed=5) for _ in range(2))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert again.errors == one.errors and again.gaps == one.gaps
    ours = one.model.state_dict()
    assert all(torch.equal(value, ours[name]) for name, value in again.model.state_dict().items())
    other = distillation.refine(model, few, few, changed(images=16), seed=6).model.state_dict()
    assert any(not torch.equal(value, ours[name]) for name, value in other.items())


def test_images_teach_no_camera_where_renderings_alone_do():
    start, few = untrained("lambert", 8)
    for fitted in (True, False):
        how = changed(images=16, rendered=0, fitted_cameras=fitted)
        made = distillation.refine(start, few, few, how).model
        learned, cameras = made.nets["camera"].state_dict(), start.nets["camera"].state_dict()
        kept = [torch.equal(learned[name], value) for name, value in cameras.items()]
        assert not any(kept) if fitted else all(kept)


def test_the_confidence_net_stays_and_the_linear_model_is_the_same(model, refined, images):
    theirs, ours = model.state_dict(), refined.model.state_dict()
    learned = tuple(f"nets.{row.name}." for row in model.factors)
    kept = [name for name in theirs if not name.startswith(learned)]
    assert kept and all(torch.equal(ours[name], theirs[name]) for name in kept)
    assert not refined.model.training and not any(p.requires_grad for p in refined.model.parameters())
    assert model.fitting is not None and refined.model.fitting is not None
    for name, value in model.fitting.maps.state_dict().items():
        assert torch.equal(value, refined.model.fitting.maps.state_dict()[name])
    features = refined.model.embed(images[:3].float() / 255)
    assert features["geometry"].shape == (3, 256)


def test_renderings_come_with_the_scene_they_show(model, images, meant):
    pictures = images.float() / 255
    half = changed(rendered=0.5, exchanged=0.5)
    shown, scene = distillation.examples(model, pictures, meant, half, torch.Generator().manual_seed(0))
    assert shown.shape == pictures.shape and len(scene) == 16
    made: Rendering = model.render(scene[:8])
    seen = made.mask.bool()[:, None].expand_as(made.image)
    torch.testing.assert_close(shown[:8][seen], made.image.clamp(0, 1)[seen], atol=1e-4, rtol=0)
    assert not torch.allclose(scene.camera[:8], meant.camera[:8], atol=0.05)
    torch.testing.assert_close(scene.depth[:4], meant.depth[:4].roll(1, 0))
    torch.testing.assert_close(scene.depth[4:8], meant.depth[4:8])
    torch.testing.assert_close(scene.albedo[:8], meant.albedo[:8])
    mirrored = (shown[8:] == pictures[8:].flip(-1)).flatten(1).all(dim=1)
    straight = (shown[8:] == pictures[8:]).flatten(1).all(dim=1)
    assert mirrored.any() and straight.any() and (mirrored | straight).all()
    torch.testing.assert_close(scene.camera[8:, 1][mirrored], -meant.camera[8:, 1][mirrored])
    torch.testing.assert_close(scene.light[8:][straight], meant.light[8:][straight])


def framed(**refining) -> distillation.RefineConfig:
    """Lessons half of which are shown in other frames."""
    return changed(reframed=0.5, **refining).model_copy(update={"reframe": FRAMES, "whitening": NONE})


def test_pictures_in_other_frames_come_with_the_camera_that_sees_them_so(model, images, meant):
    pictures = images.float() / 255
    draw = torch.Generator().manual_seed(0)
    shown, scene = distillation.examples(model, pictures, meant, framed(rendered=0), draw)
    away = scene.camera[:, 5] - meant.camera[:, 5]
    moved = away.abs() > 1e-6
    assert 3 < moved.sum() < 13
    assert 0.5 < away.max() < 0.9 and away.min() > 1 / 1.15 - 1.01
    mirrored = shown.flip(-1)
    as_it_is = [(one[~moved] == pictures[~moved]).flatten(1).all(dim=1) for one in (shown, mirrored)]
    assert (as_it_is[0] | as_it_is[1]).all()
    again = model.render(scene)
    errors = [masked_l1(again.image[rows], shown[rows], again.mask[rows]) for rows in (moved, ~moved)]
    assert errors[0] < 1.3 * errors[1], "the moved scenes render the framed images"
    still = model.render(scene.with_parameters(camera=scene.camera * torch.tensor([1, 1, 1, 0, 0, 0])))
    assert masked_l1(still.image[moved], shown[moved], still.mask[moved]) > 1.35 * errors[0]


def test_a_copy_distilled_so_steps_back_from_smaller_faces(model, images):
    lessons = framed(images=100, batch_size=4, rendered=0, learning_rate=1.5e-3)
    learned = distillation.refine(model, images, images[:2], lessons, seed=5).model
    assert learned.settings.ranges.translation_z == pytest.approx(0.9 / 0.75)
    assert model.settings.ranges.translation_z == 0
    pictures = images.float() / 255
    smaller = crop_images(pictures, torch.tensor([[[1.7, 0, 0], [0, 1.7, 0]]]).expand(len(pictures), 2, 3))
    near, far = (learned.decompose(one).camera[:, 5] for one in (pictures, smaller))
    assert (far > near).float().mean() > 0.9
    assert float(far.mean() - near.mean()) > 0.02, "the part of 0.7 that few examples show"


@pytest.mark.parametrize("renderer", ["phong+haze", "sh"])
def test_further_factors_are_learnt_too(renderer):
    """From an untrained model, all of whose scenes are far from the fitted ones."""
    start, images = untrained(renderer, 16)
    refined = distillation.refine(start, images, images, changed(images=200, learning_rate=1e-3), seed=5)
    extra = {row.parameter for row in start.factors} - {"depth", "albedo", "light", "camera"}
    assert extra and {row.parameter for row in start.factors} == set(refined.gaps)
    assert all(refined.gaps[name]["now"] < 0.9 * refined.gaps[name]["before"] for name in extra)
    assert refined.errors["now"] < refined.errors["before"]
    fitted = distillation.fit_scenes(start, images[:16], 2, print).scene(start.fitting.maps)
    draw, pictures = torch.Generator().manual_seed(0), images[:16].float() / 255
    shown, scene = distillation.examples(start, pictures, fitted, changed(rendered=0.5), draw)
    again, seen = start.render(scene[:8]), 0.99
    covered = (again.mask > seen)[:, None].expand_as(again.image)
    torch.testing.assert_close(shown[:8][covered], again.image.clamp(0, 1)[covered], atol=1e-4, rtol=0)
    assert all(not torch.allclose(scene.extra[name][:8], fitted.extra[name][:8]) for name in extra)


def test_what_cannot_be_refined_is_named(model, images):
    with pytest.raises(ValueError, match="2 images or more of 64 pixels and one held out, got 1 of 64"):
        distillation.refine(model, images[:1], images[1:])
    with pytest.raises(ValueError, match="and one held out, got 16 of 64 and 0"):
        distillation.refine(model, images, images[:0])
    with pytest.raises(ValueError, match="cannot optimise scenes per image yet"):
        distillation.refine(model.without_features(), images[:4], images[4:])


def test_weights_that_are_no_numbers_are_an_error(model, images):
    broken = derender.load("rendered-faces-64")
    broken.nets["confidence"].requires_grad_(False)
    next(broken.nets["confidence"].parameters()).fill_(float("nan"))
    with pytest.raises(ValueError, match="NaN or infinite after 8 images"):
        distillation.refine(broken, images[:8], images[:1], changed(images=8, fit_steps=1))


def test_only_clear_fits_are_distilled():
    """The worst, those that are no numbers and those that show nothing are left out."""
    error = torch.tensor([0.02, 0.03, 0.0, 0.01, 0.5])
    light = torch.rand(5, 4)
    light[3, 1] = float("nan")
    fits = distillation.FittedScenes({"light": light, "camera": torch.rand(5, 6)}, error)
    assert fits.clear(0.2).tolist() == [True, True, False, False, False]
    assert fits.clear(0).tolist() == [True, True, False, False, True]
