"""Scenes of images in other frames, rendered, show the images so framed; ranges give the camera room."""

import pytest
import torch
from torch import Tensor

from derender.networks.factors import camera_from_raw
from derender.render.renderer import render_scene
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
