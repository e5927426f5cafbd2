"""Images in other frames, their scenes rendered, and ranges that give the camera room."""

import pytest
import torch
from torch import Tensor

from derender.networks.factors import camera_from_raw
from derender.render import render_scene
from derender.scene import Scene
from derender.scene.crop import CropSettings, crop_images, crop_scene, random_crops, ranges_for_crops
from derender.scene.ranges import SceneRanges

FRAMES = CropSettings(nearer=1.15, farther=1.9, shift=0.25, roll_deg=20)


def scenes(camera: Tensor) -> Scene:
    """A bump with large soft spots, seen by each camera."""
    count, line = len(camera), torch.linspace(-1, 1, 65)
    bump = 1.04 - 0.08 * torch.exp(-4 * (line[:, None].square() + (line - 0.2).square()))
    coarse = torch.rand(count, 3, 6, 6, generator=torch.Generator().manual_seed(0))
    albedo = torch.nn.functional.interpolate(coarse, (65, 65), mode="bicubic").clamp(0, 1)
    light = torch.tensor([0.3, 0.6, 0.3, -0.4]).expand(count, 4)
    return Scene(bump.expand(count, 65, 65).contiguous(), albedo, light, camera)


@pytest.mark.parametrize("already", [0.0, 1.0], ids=["as it was", "moved already"])
def test_rendered_it_is_the_picture_in_its_frame(already):
    frames = random_crops(32, torch.Generator().manual_seed(1), FRAMES)
    scene = scenes(already * torch.tensor([[0.1, -0.2, 0.15, 0.01, -0.008, 0.2]]).expand(32, 6))
    straight, moved = render_scene(scene), render_scene(crop_scene(scene, frames, 10.0))
    framed = crop_images(straight.image, frames)
    mask = straight.mask[:, None].expand_as(framed)
    covered = crop_images(mask, frames, torch.zeros_like(mask))[:, 0] * moved.mask > 0.99
    assert covered.float().mean() > 0.3
    apart, aside = ((framed - other.image).abs().mean(dim=1)[covered] for other in (moved, straight))
    assert apart.mean() < 0.012
    assert apart.mean() < 0.15 * aside.mean(), "the frames move what is seen"


def test_each_number_of_the_camera_moves_as_the_frame_says():
    frames = torch.tensor([[[0.0, -1.5, 0.2], [1.5, 0.0, 0.0]]])  # a quarter turn, 1.5 times as far, aside
    scene = scenes(torch.tensor([[0.3, 0.2, 0.1, 0.0, 0.0, 0.1]]))
    camera = crop_scene(scene, frames, 10.0).camera[0]
    assert camera[:2].tolist() == scene.camera[0, :2].tolist()
    assert float(camera[2]) == pytest.approx(0.1 - torch.pi / 2)
    assert float(camera[5]) == pytest.approx(1.5 * 1.1 - 1)
    aside = 0.2 * 1.1 * torch.tan(torch.deg2rad(torch.tensor(5.0))) * 65 / 64
    assert float(camera[4]) == pytest.approx(float(aside), rel=1e-4)  # the frame's x points down
    assert float(camera[3]) == pytest.approx(0, abs=1e-6)


def test_ranges_reach_every_camera_that_frames_ask_for():
    narrow = SceneRanges(translation_xy=0.01)
    ranges = ranges_for_crops(narrow, 65, FRAMES)
    frames = random_crops(2_000, torch.Generator().manual_seed(2), FRAMES)
    moved = crop_scene(scenes(torch.zeros(1, 6)).map(lambda v: v.expand(2_000, *v.shape[1:])), frames, 10.0)
    most = camera_from_raw(torch.full((1, 6), 0.75), ranges)[0]  # three quarters of what can be said
    furthest = moved.camera.abs().amax(dim=0)
    assert (furthest[3:] <= most[3:] * 1.01).all() and (furthest[5:] > 0.8 * most[5:]).all()
    assert ranges.translation_z == pytest.approx(1.2)
    wide = SceneRanges(translation_xy=0.5, translation_z=2.0)
    assert ranges_for_crops(wide, 65, FRAMES) == wide


STILL = {"nearer": 1, "farther": 1, "shift": 0, "roll_deg": 0}


def spot(row: int, column: int) -> Tensor:
    """A dark image of 33 pixels with one bright pixel, whose middle is pixel (16, 16)."""
    image = torch.zeros(1, 3, 33, 33)
    image[:, :, row, column] = 1
    return image


def brightest(image: Tensor) -> tuple[int, int]:
    return divmod(int(image[0, 0].flatten().argmax()), image.shape[-1])


def moves(**changes: float) -> Tensor:
    settings = CropSettings(**{**STILL, **changes})
    return random_crops(400, torch.Generator().manual_seed(0), settings)


def test_frames_stay_within_their_bounds_and_reach_them():
    zoomed, shifted, turned = moves(nearer=1.5, farther=1.25), moves(shift=0.2), moves(roll_deg=10)
    assert 0.66 < zoomed[:, 0, 0].min() < 0.69 and 1.23 < zoomed[:, 0, 0].max() < 1.25
    assert torch.equal(zoomed[:, 0, 0], zoomed[:, 1, 1]) and zoomed[:, 0, 1].abs().max() == 0
    assert all(0.19 < shifted[:, axis, 2].abs().max() <= 0.2 for axis in (0, 1))
    degrees = torch.rad2deg(torch.atan2(turned[:, 1, 0], turned[:, 0, 0]))
    assert 9.7 < degrees.max() < 10.01 and -10.01 < degrees.min() < -9.7
    assert turned[:, :, 2].abs().max() == 0


def test_a_frame_says_where_its_pixels_lie_in_the_picture():
    larger = torch.tensor([[[2.0, 0, 0], [0, 2.0, 0]]])  # shows twice as much: the spot moves inwards
    assert brightest(crop_images(spot(16, 24), larger)) == (16, 20)
    beside = torch.tensor([[[1.0, 0, 8 / 16.5], [0, 1.0, 0]]])  # looks 8 pixels to the right
    assert brightest(crop_images(spot(16, 24), beside)) == (16, 16)
    quarter = torch.tensor([[[0.0, -1.0, 0], [1.0, 0, 0]]])
    assert brightest(crop_images(spot(16, 24), quarter)) == (8, 16)


def test_beyond_the_edge_lies_the_reflection_or_what_is_given():
    images, around = torch.rand(2, 1, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    aside = torch.tensor([[[1.0, 0, 0.5], [0, 1.0, 0]]])  # two pixels to the right
    reflected, shown = crop_images(images, aside), crop_images(images, aside, around)
    torch.testing.assert_close(reflected, torch.cat([images[..., 2:], images[..., 6:].flip(-1)], dim=-1))
    assert torch.equal(shown, torch.cat([reflected[..., :6], around[..., 6:]], dim=-1))
    whole = torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]]])
    assert torch.equal(crop_images(images, whole, around), images)


def test_the_share_that_is_not_framed_anew_stays_bit_for_bit():
    images = torch.rand(300, 3, 8, 8, generator=torch.Generator().manual_seed(2))
    frames = random_crops(300, torch.Generator().manual_seed(0), CropSettings(), share=0.25)
    same = (crop_images(images, frames) == images).flatten(1).all(dim=1)
    assert 0.68 < same.float().mean() < 0.82
