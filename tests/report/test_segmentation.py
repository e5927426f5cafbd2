"""Masks in colours: the colour of every class, pixels that stay squares, a legend with every name."""

import numpy as np

from derender.data import MASK_CLASSES
from derender.report.panel import GridLayout
from derender.report.protocols import OPACITY, overlays, palette, segmentation_sheet


def test_every_class_has_a_colour_of_its_own():
    colours = palette(40)
    assert colours.shape == (40, 3) and len({tuple(row) for row in colours.tolist()}) == 40
    faces = palette(len(MASK_CLASSES)).astype(int)
    apart = np.abs(faces[:, None] - faces[None]).sum(axis=-1) + 999 * np.eye(len(faces))
    assert apart.min() > 60


def test_an_overlay_is_the_picture_under_the_classes_colour():
    pictures = np.full((1, 3, 2, 2), 100, np.uint8)
    masks = np.array([[[0, 1], [2, 3]]], np.uint8)
    (image,) = overlays(pictures, masks, 4, scale=3)
    pixels = np.asarray(image).astype(float)
    assert image.size == (6, 6)
    for (row, column), number in np.ndenumerate(masks[0]):
        expected = (1 - OPACITY) * 100 + OPACITY * palette(4)[number]
        assert np.abs(pixels[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] - expected).max() <= 1


def test_the_sheet_has_a_column_for_each_answer_and_the_legend_below():
    random = np.random.default_rng(0)
    pictures = random.integers(0, 256, (2, 3, 8, 8), dtype=np.uint8)
    masks = random.integers(0, 19, (2, 8, 8), dtype=np.uint8)
    layout = GridLayout(cell=40, gap=4, margin=10, label=12)
    sheet = segmentation_sheet(pictures, masks, {"joint": masks, "random": masks}, MASK_CLASSES, layout)
    assert sheet.width == 20 + 4 * 40 + 3 * 4
    below = np.asarray(sheet)[2 * 10 + 12 + 4 + 2 * 40 + 4 :]
    colours = {tuple(row) for row in below.reshape(-1, 3).tolist()}
    assert {tuple(row) for row in palette(19).tolist()} <= colours
