"""A square cut out of a photograph and put back: what lies where, beyond the border, and turned."""

import numpy as np
import pytest
import torch

from derender.photo import Frame


def ramp(height: int, width: int) -> np.ndarray:
    """Red grows to the right, green downwards, one level a pixel."""
    photo = np.zeros((height, width, 3), np.uint8)
    photo[..., 0], photo[..., 1] = np.arange(width), np.arange(height)[:, None]
    return photo


def test_the_middle_square_is_cut_without_resampling():
    cut = Frame.centred(60, 40).cut(ramp(40, 60), 40)
    assert (cut == ramp(40, 60)[:, 10:50].transpose(2, 0, 1)).all()


def test_half_the_size_averages():
    cut = Frame(32, 24, 32).cut(ramp(48, 64), 16)
    assert np.abs(cut[0, 4:-4, 4:-4] - (np.arange(16) * 2 + 16.5)[4:-4]).max() <= 1


def test_beyond_the_photograph_its_border_goes_on():
    cut = Frame(0, 20, 20).cut(ramp(40, 60), 20)
    assert (cut[0, :, :10] == 0).all()
    assert (cut[0, :, 10:] == np.arange(10)).all()


@pytest.mark.parametrize("roll", [90.0, 30.0, -45.0])
def test_a_turned_frame_has_its_corners_where_it_says(roll):
    frame = Frame(50, 45, 40, roll)
    cut = frame.cut(ramp(90, 100), 80)
    for (x, y), (row, column) in zip(frame.corners(), ((0, 0), (0, -1), (-1, -1), (-1, 0)), strict=True):
        assert np.abs(cut[:2, row, column].astype(float) - (x, y)).max() < 2


@pytest.mark.parametrize("frame", [Frame(30, 20, 90), Frame(0, 20, 40), Frame(30, 15, 80, 30.0)])
def test_what_is_visible_of_a_part_holds_all_that_shows_the_photograph(frame):
    white = np.full((40, 60, 3), 255, np.uint8)
    around = np.pad(white, ((200, 200), (200, 200), (0, 0)))  # black
    hidden = Frame(frame.x + 200, frame.y + 200, frame.side, frame.roll_deg).cut(around, 60)
    assert hidden.max() == 255
    assert hidden[0, frame.beyond(60, 40, 60).numpy() > 2 / 60].max() < 128
    rows, columns = frame.visible(60, 40, 60)
    hidden[:, rows, columns] = 0
    assert hidden.max() == 0
    assert (rows.stop - rows.start) * (columns.stop - columns.start) < 60 * 60
    assert Frame(-500, 20, 40).visible(60, 40, 60) == (slice(0, 60), slice(56, 60))  # beside it


@pytest.mark.parametrize("frame", [Frame(30, 20, 24), Frame(30.4, 20.7, 21.5, 25.0), Frame(2, 2, 30)])
def test_an_unchanged_part_leaves_the_photograph_as_it_is(frame):
    photo = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    part = torch.from_numpy(frame.cut(photo, 24)).float() / 255
    assert (frame.paste(photo, part, part) == photo).all()


@pytest.mark.parametrize("frame", [Frame(30, 20, 24), Frame(30, 24, 20, 40.0)])
def test_what_changed_appears_in_its_place_only(frame):
    photo = np.full((48, 64, 3), 100, np.uint8)
    before = torch.from_numpy(frame.cut(photo, 24)).float() / 255
    pasted = frame.paste(photo, before, before + 0.2)
    assert (pasted[round(frame.y), round(frame.x)] == 151).all()
    assert (pasted[0] == 100).all() and (pasted[:, 0] == 100).all()


def test_a_frame_beside_the_photograph_changes_nothing():
    photo = ramp(40, 60)
    part = torch.zeros(3, 8, 8)
    assert Frame(-50, 20, 20).paste(photo, part, part + 1) is photo


def test_whole_pixels_and_parts():
    frame = Frame(20.3, 20.3, 11.2).snapped()
    assert (frame.side, frame.x % 1, frame.y % 1) == (11, 0.5, 0.5)
    assert Frame(20, 20, 10).part(-0.5, 0.5, 0.5) == Frame(17.5, 22.5, 5.0)
