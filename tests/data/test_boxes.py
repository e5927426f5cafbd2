"""A layout can declare which part of each picture is read: decoding cuts it out before anything else."""

import io

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import noise

from derender.data import Unreadable
from derender.data.decode import decode


def box(*sides: float) -> np.ndarray:
    return np.array(sides, np.float32)


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
@pytest.mark.parametrize("sides", [(3, 5, 23, 25), (0, 0, 40, 30), (2.4, 4.6, 22.4, 24.6), (1, 2, 31, 12)])
def test_a_box_is_the_same_as_cutting_first(encoded, fit, sides):
    whole = noise(1, width=40, height=30)
    left, top, right, bottom = np.round(sides).astype(int)
    expected = decode(encoded(np.ascontiguousarray(whole[top:bottom, left:right])), 12, fit)
    assert (decode(encoded(whole), 12, fit, box(*sides)) == expected).all()


@pytest.mark.parametrize(
    ("sides", "inside"),
    [
        ((-5, -7, 15, 13), (0, 0, 20, 20)),
        ((30, 20, 50, 40), (20, 10, 40, 30)),
        ((-20, -30, 60, 50), (5, 0, 35, 30)),
        ((-10, 5, 70, 15), (0, 5, 40, 15)),
    ],
)
def test_a_box_that_sticks_out_is_moved_and_shrunk_into_the_picture(encoded, sides, inside):
    whole = encoded(noise(2, width=40, height=30))
    assert (decode(whole, 10, "crop", box(*sides)) == decode(whole, 10, "crop", box(*inside))).all()


@pytest.mark.parametrize("sides", [(np.nan,) * 4, (5, 5, 5, 9), (9, 9, 3, 3), (0, 0, np.inf, 9)])
def test_a_box_that_is_none_makes_the_picture_unreadable(encoded, sides):
    with pytest.raises(Unreadable, match="no usable box is known"):
        decode(encoded(3), 8, "crop", box(*sides))


def test_a_box_in_a_turned_picture_is_in_upright_pixels():
    upright = Image.fromarray(noise(4, width=40, height=30))
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying, to be turned by 90 degrees
    turned, plain = io.BytesIO(), io.BytesIO()
    upright.transpose(Image.Transpose.ROTATE_90).save(turned, "PNG", exif=exif)
    upright.save(plain, "PNG")
    sides = box(10, 2, 30, 22)
    assert (decode(turned.getvalue(), 9, "crop", sides) == decode(plain.getvalue(), 9, "crop", sides)).all()


def test_a_box_holds_where_the_jpeg_is_decoded_at_a_reduced_scale(encoded):
    """A ramp says where the pixels came from: the mean of each column is its place in the picture."""
    ramp = np.broadcast_to(np.linspace(0, 255, 1024)[None, :, None], (512, 1024, 3)).astype(np.uint8)
    jpeg = encoded(ramp, "JPEG", quality=95)
    part = decode(jpeg, 16, "crop", box(256, 100, 640, 484)).mean(axis=(0, 1))
    centres = 256 + (np.arange(16) + 0.5) * 384 / 16
    assert np.abs(part - centres / 1024 * 255).max() < 1.5
    small = decode(jpeg, 16, "crop", box(512, 100, 528, 116)).mean()
    assert abs(small - 520 / 1024 * 255) < 1.5
