"""U-Net encoders distilled from a model: targets by pixel, what they learn of it, what stays as it was."""

import pytest
import torch

import derender
from derender.data.synthetic import faces
from derender.networks.encoders import PIXEL_CHANNELS, NetworkSettings, UNetEncoder
from derender.objectives.reconstruction import masked_l1
from derender.presets import ModelSettings
from derender.scene.ranges import SceneRanges
from derender.training import unets

SIZES = NetworkSettings(image_size=32, width=8, light_width=4, code_size=16)


@pytest.fixture(scope="module")
def model():
    ranges = SceneRanges(border_depth=1.06)
    return derender.Derenderer.seeded(ModelSettings(network=SIZES, ranges=ranges), seed=3).eval()


@pytest.fixture(scope="module")
def images():
    draw = torch.Generator().manual_seed(1)
    return torch.randint(0, 256, (24, 3, 32, 32), generator=draw, dtype=torch.uint8)


def joint_maps(model, images) -> torch.Tensor:
    """Maps that the decoder over both encoders predicts, (N, 6, H, W)."""
    pictures = images.float() / 255
    levels = zip(*(model.nets[name].encoder.skips(pictures) for name in PIXEL_CHANNELS), strict=True)
    return model.unet_decoder([torch.cat(level, dim=1) for level in levels])


SHORT = unets.UNetSettings(images=48, batch_size=8, unet_width=4, learning_rate=3e-3)


@pytest.fixture(scope="module")
def distilled(model, images):
    return unets.distil_unets(model, images, SHORT, seed=5)


def test_seen_from_the_front_each_pixel_lies_where_it_is(model, images):
    pictures = images[:3].float() / 255
    scene = model.decompose(pictures)
    facing = scene.with_parameters(camera=torch.zeros_like(scene.camera))
    model_facing = derender.Derenderer(model.settings)
    model_facing.load_state_dict(model.state_dict())
    model_facing.eval().decode = lambda codes: facing
    target = unets.pixel_targets(model_facing, pictures)
    line = torch.linspace(-1, 1, 32)
    inside = target.mask.bool()
    assert inside.float().mean() > 0.8
    across, down = target.maps["geometry"][:, 0], target.maps["geometry"][:, 1]
    torch.testing.assert_close(across[inside], line.expand(3, 32, 32)[inside], atol=1e-3, rtol=0)
    torch.testing.assert_close(down[inside], line.view(32, 1).expand(3, 32, 32)[inside], atol=1e-3, rtol=0)
    depth = target.maps["geometry"][:, 2] * 0.1 + 1
    torch.testing.assert_close(depth[inside], facing.depth[inside], atol=1e-4, rtol=0)
    shown = target.maps["albedo"].permute(0, 2, 3, 1)
    torch.testing.assert_close(shown[inside], facing.albedo.permute(0, 2, 3, 1)[inside], atol=1e-3, rtol=0)


def test_pictures_and_what_is_said_of_them_move_together(model, images):
    pictures = images[:8].float() / 255
    line = torch.linspace(-1, 1, 32).expand(8, 32, 32)
    maps = {"geometry": torch.stack([line, line.mT, line * 0], dim=1), "albedo": pictures.clone()}
    target = unets.PixelTargets(maps, torch.ones(8, 32, 32), {})
    shown, moved, mask = unets.augmented(pictures, target, 2, torch.Generator().manual_seed(0))
    torch.testing.assert_close(shown[:2], pictures[:2], atol=1e-5, rtol=0)
    torch.testing.assert_close(moved["geometry"][:2], maps["geometry"][:2], atol=1e-5, rtol=0)
    assert not torch.allclose(shown[2:], pictures[2:], atol=0.1)
    inside = mask[2:].bool()
    # lit otherwise, an image is an affine function of the albedo that moved with it
    for picture, albedo, kept in zip(shown[2:], moved["albedo"][2:], inside, strict=True):
        seen, meant = picture[0][kept], albedo[0][kept]
        within = (seen > 0.02) & (seen < 0.98)
        together = torch.corrcoef(torch.stack([seen[within], meant[within]]))[0, 1]
        assert together > 0.999
    steps = moved["geometry"][:, 0].diff(dim=2)[mask[:, :, 1:].bool() & mask[:, :, :-1].bool()]
    assert (steps > 0).all(), "of a mirror image the other side is meant: places go on from left to right"


def test_the_copy_has_unets_and_all_else_stays(model, distilled, images):
    copy = distilled.model
    assert copy.settings.network.encoder == "unet" and copy.settings.ranges == model.settings.ranges
    assert all(isinstance(copy.nets[name].encoder, UNetEncoder) for name in PIXEL_CHANNELS)
    fresh = tuple(f"nets.{name}.encoder." for name in PIXEL_CHANNELS)
    theirs, ours = model.state_dict(), copy.state_dict()
    kept = [name for name in theirs if not name.startswith(fresh)]
    assert kept and all(torch.equal(ours[name], theirs[name]) for name in kept)
    assert not copy.training and not any(value.requires_grad for value in copy.parameters())
    assert copy.embed(images[:2].float() / 255)["geometry"].shape == (2, 16)


def test_the_decoder_is_saved_with_the_copy(distilled, images, tmp_path):
    again = derender.load(distilled.model.save(tmp_path / "copy"))
    assert joint_maps(again, images).shape == (24, 6, 32, 32)
    torch.testing.assert_close(joint_maps(again, images), joint_maps(distilled.model, images))


def test_it_learns_what_the_model_predicts():
    model = derender.load("rendered-faces-64")
    images = torch.from_numpy(faces.generate(16, image_size=64, seed=9).images)
    settings = unets.UNetSettings(images=320, batch_size=8, unet_width=4, learning_rate=5e-3)
    distilled = unets.distil_unets(model, images, settings)
    hardly = unets.distil_unets(model, images, settings.model_copy(update={"images": 16}))
    assert distilled.errors["place"] < 0.75 * hardly.errors["place"]
    assert distilled.errors["albedo"] < 0.65 * hardly.errors["albedo"]
    assert distilled.errors["depth"] < 0.8 * hardly.errors["depth"]
    pictures = images.float() / 255
    target = unets.pixel_targets(model, pictures)
    maps = torch.cat([*target.maps.values()], dim=1)
    jointly = (joint_maps(one.model, images) for one in (distilled, hardly))
    ours, none = (masked_l1(one, maps, target.mask) for one in jointly)
    assert ours < 0.9 * none, "the decoder over both learns it, too"
    theirs, ours, none = (one.encode(pictures)["albedo"] for one in (model, distilled.model, hardly.model))
    assert (ours - theirs).square().mean() < 0.97 * (none - theirs).square().mean()
    before = distilled.errors["reconstruction before"]
    assert before == hardly.errors["reconstruction before"] < distilled.errors["reconstruction"]


def test_the_same_seed_distils_the_same_and_nothing_else_is_touched(model, images, distilled):
    before, state = torch.random.get_rng_state(), {k: v.clone() for k, v in model.state_dict().items()}
    again = unets.distil_unets(model, images, SHORT, seed=5)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert all(torch.equal(v, distilled.model.state_dict()[k]) for k, v in again.model.state_dict().items())
    assert again.errors == distilled.errors


def test_what_cannot_be_distilled_is_named(model, images):
    with pytest.raises(ValueError, match="2 images or more of 32 pixels to learn from, got 1 of 32"):
        unets.distil_unets(model, images[:1])
    with pytest.raises(ValueError, match="got 24 of 16"):
        unets.distil_unets(model, images[..., :16, :16])
    with pytest.raises(ValueError, match="a model grown from 64 pixels takes no U-Nets"):
        unets.distil_unets(derender.load("faces-128"), torch.zeros(2, 3, 128, 128, dtype=torch.uint8))


def test_weights_that_are_no_numbers_are_an_error(model, images):
    broken = derender.Derenderer(model.settings)
    broken.load_state_dict(model.state_dict())
    next(broken.nets["albedo"].decoder.parameters()).data.fill_(float("nan"))
    with pytest.raises(ValueError, match="NaN or infinite after 16 images"):
        unets.distil_unets(broken.eval(), images, SHORT.model_copy(update={"images": 16}))
