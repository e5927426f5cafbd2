"""Images show what the values say: sizes, labels, one scale for a set, normals, transparency."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from derender.model import Derenderer
from derender.report import colours, panel
from derender.report import decomposition as drawing
from derender.report.decomposition import COLUMN_MEANING, decomposition
from derender.report.panel import GridLayout, contact_sheet, labelled_grid
from derender.scene import Scene

MODEL = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)


def bump(count: int = 3, size: int = 16) -> Scene:
    """A hill in the middle of a plane, lit from different sides."""
    axis = torch.linspace(-1, 1, size)
    hill = 1.05 - 0.1 * torch.exp(-4 * (axis[:, None] ** 2 + axis[None] ** 2))
    light = torch.tensor([0.4, 0.5, 0.0, 0.0]).repeat(count, 1)
    light[:, 3] = torch.linspace(-0.5, 0.5, count)
    camera = torch.zeros(count, 6)
    camera[:, 1] = torch.linspace(-0.3, 0.3, count)
    return Scene(hill.repeat(count, 1, 1), torch.full((count, 3, size, size), 0.6), light, camera)


def test_every_column_is_drawn_and_a_further_factor_where_its_parameter_is_a_map():
    extra = {"gloss": torch.rand(3, 16, 16), "tint": torch.rand(3, 3, 16, 16), "age": torch.rand(3, 2)}
    scene = replace(bump(), extra=extra)
    drawn = decomposition(MODEL, MODEL.render(scene).image.clamp(0, 1), scene)
    assert list(drawn.columns) == [*COLUMN_MEANING, "gloss", "tint"]
    assert all([image.size for image in images] == [(16, 16)] * 3 for images in drawn.columns.values())


def test_panel_has_the_expected_size_and_labels(monkeypatch):
    written, pen, text = [], ImageDraw.ImageDraw, ImageDraw.ImageDraw.text
    monkeypatch.setattr(pen, "text", lambda *all, **more: written.append(all[2]) or text(*all, **more))
    scene = bump()
    drawn = decomposition(MODEL, MODEL.render(scene).image.clamp(0, 1), scene)
    layout = GridLayout(cell=90, gap=10, margin=20, label=12)
    one = labelled_grid({name: images[1:2] for name, images in drawn.columns.items()}, layout=layout)
    assert written == list(COLUMN_MEANING)
    assert one.size == (20 + 8 * 90 + 7 * 10 + 20, 20 + 12 + 10 + 90 + 20)
    sheet = labelled_grid(drawn.columns, ["a.jpg", "b.jpg", "c.jpg"], layout=layout)
    assert sheet.height == one.height + 2 * (90 + 10) and sheet.width > one.width
    assert {"a.jpg", "b.jpg", "c.jpg"} <= set(written)


def test_contact_sheet_and_pairs():
    images = [Image.new("RGB", (8, 8), (index * 20, 0, 0)) for index in range(5)]
    grid = labelled_grid({"a": images[:1], "b": images[4:]}, layout=GridLayout(40, 10, 20, 10))
    assert [grid.getpixel((x, 60))[0] for x in (40, 90)] == [0, 80]  # cells show their images
    layout = GridLayout(cell=20, gap=5, margin=10, label=10)
    assert contact_sheet(images, across=3, layout=layout).size == (10 + 3 * 25 - 5 + 10, 10 + 2 * 25 - 5 + 10)
    assert contact_sheet(images, ["x"] * 5, across=3, layout=layout).height == 10 + 2 * (25 + 15) - 5 + 10


def test_long_names_are_shortened_in_the_middle_and_kept_on_one_line():
    font = panel.ImageFont.load_default(12)
    short = panel.shortened("holiday\npictures/of_a_very_long_name_000123.jpg", font, 100)
    assert "…" in short and short.startswith("hol") and short.endswith(".jpg") and "\n" not in short
    assert font.getlength(short) <= 100


def test_near_is_brighter_and_the_scale_is_one_for_the_set():
    depth = np.stack([np.full((4, 4), z, np.float32) for z in (0.9, 1.0, 1.1)])
    levels = [np.asarray(image.convert("L"))[0, 0] for image in colours.depth_maps(depth)]
    assert levels[0] > levels[1] > levels[2]
    mask = np.ones_like(depth)
    mask[2] = 0
    near, far = colours.depth_range(depth, mask)
    assert (near, far) == pytest.approx((0.9, 1.0))
    assert colours.depth_range(depth, np.zeros_like(depth)) == (0.0, 1.0)


def test_normals_are_red_to_the_right_and_green_upwards():
    toward, right, up = [0, 0, 1], [-0.6, 0, 0.8], [0, 0.6, 0.8]  # inward normals, y down
    image = colours.normal_maps(np.array([[toward, right, up]], np.float32)[:, None])[0]
    flat, to_right, upwards = (image.getpixel((x, 0)) for x in range(3))
    assert flat == (128, 128, 255)
    assert to_right[0] > 200 and to_right[1] == 128
    assert upwards[1] > 200 and upwards[0] == 128


def test_uncovered_pixels_are_transparent_and_white_on_paper():
    mask = np.zeros((1, 2, 2))
    mask[0, 0] = 1
    image = colours.pictures(np.zeros((1, 3, 2, 2), np.uint8), mask)[0]
    assert image.mode == "RGBA" and image.getpixel((0, 1))[3] == 0
    paper = colours.on_background(image)
    assert paper.getpixel((0, 0)) == (0, 0, 0) and paper.getpixel((0, 1)) == (255, 255, 255)
    with pytest.raises(ValueError, match=r"shape \(N, 3, H, W\)"):
        colours.pictures(np.zeros((2, 4, 4, 3)))


def test_another_light_comes_from_the_other_side_and_another_view_turns_back():
    scene = bump()
    light, camera = drawing.under_another_light(scene).light, drawing.from_another_view(scene).camera
    assert (light[:, 3].sign() == torch.tensor([1.0, 1.0, -1.0])).all()
    torch.testing.assert_close(light[:, :2].sum(dim=1), scene.light[:, :2].sum(dim=1))  # as bright
    assert (camera[:, 1] - scene.camera[:, 1]).abs() == pytest.approx([radians(35)] * 3)
    assert camera[0, 1] > scene.camera[0, 1] and camera[2, 1] < scene.camera[2, 1]
    assert torch.equal(scene.light, bump().light)
