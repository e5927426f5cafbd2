"""Small PNG files: any reader gives back exactly what was encoded."""

import io

import numpy as np
import pytest
from PIL import Image

from derender.data.synthetic.write import encode_png


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (64, 64), (7, 9, 3)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_pixels_come_back(shape, kind):
    if len(shape) == 3 and kind is np.uint16:
        pytest.skip("RGB has 8 bits")
    pixels = np.random.default_rng(1).integers(0, np.iinfo(kind).max + 1, shape, dtype=kind)
    with Image.open(io.BytesIO(encode_png(pixels))) as picture:
        picture.verify()
    read = np.asarray(Image.open(io.BytesIO(encode_png(pixels))))
    assert read.dtype == kind and (read == pixels).all()


def test_views_are_encoded_and_flat_maps_are_small():
    pixels = np.random.default_rng(2).integers(0, 256, (3, 8, 8), dtype=np.uint8).transpose(1, 2, 0)
    assert (np.asarray(Image.open(io.BytesIO(encode_png(pixels)))) == pixels).all()
    assert len(encode_png(np.zeros((64, 64), np.uint8))) < 150
