"""Small PNG files, fast: whole rows predicted from the row above, light compression.

Pillow tries five predictions on every row and builds its chunks in Python; for the maps of 64-pixel pictures
that is most of the time that saving takes. Leaves out palettes, transparency and interlacing.
"""

import struct
import zlib

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _RGB = 0, 2
_ABOVE = 2  # the number of the prediction
_LEVEL = 1


def encode_png(
    pixels: UInt8[ndarray, "h w"] | UInt16[ndarray, "h w"] | UInt8[ndarray, "h w 3"],
) -> bytes:
    """The file of one picture: grey of 8 or 16 bits, or RGB of 8 bits."""
    height, width = pixels.shape[:2]
    rows = pixels.astype(pixels.dtype.newbyteorder(">"), copy=False).reshape(height, -1).view(np.uint8)
    lines = np.empty((height, 1 + rows.shape[1]), np.uint8)
    lines[:, 0] = _ABOVE
    lines[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=lines[1:, 1:])
    kind = _RGB if pixels.ndim == 3 else _GREY
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, kind, 0, 0, 0)
    data = zlib.compress(lines.tobytes(), _LEVEL)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
