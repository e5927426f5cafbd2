"""One pass over all pictures: brightness, clipping, colour, and small grey versions of each.

Works in chunks, so that a memory-mapped set is never in memory whole; what is kept is 1.1 KB a picture.
Greys are 0.299 R + 0.587 G + 0.114 B of the values as stored (ITU-R BT.601).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

GREY_PX = 32
"""Side of the grey pictures that structure and variety are measured on."""

TINY_PX = 16
"""Side of the grey pictures that near copies are found by."""

DARK, BRIGHT = 2, 253
"""At or beyond these values of 255 a channel counts as clipped."""

_CHUNK = 256
_COLOURLESS = 4.0  # mean distance of the channels, in values of 255: below it no colour is seen
_BLANK = 2.0  # standard deviation of grey, in values of 255: below it there is nothing to see
_WEIGHTS = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class Pixels:
    """One row for each picture.

    Attributes:
        tiny: grey pictures with mean 0 and length 1 (0 throughout for blank ones).
        dark: share of pixels that are black in every channel, 0..1.
        bright: share of pixels that are white in every channel, 0..1.
        colourless: the picture shows no colour.
        blank: the picture shows one brightness only.
    """

    tiny: Float32[np.ndarray, "n 256"]
    dark: Float32[np.ndarray, " n"]
    bright: Float32[np.ndarray, " n"]
    colourless: Bool[np.ndarray, " n"]
    blank: Bool[np.ndarray, " n"]


def measure_pixels(
    images: UInt8[np.ndarray, "n 3 s s"], progress: Callable[[int, int], object] | None = None
) -> Pixels:
    """Measure every picture; the side must be a multiple of 32 pixels."""
    count = len(images)
    tiny = np.empty((count, TINY_PX * TINY_PX), np.float32)
    dark, bright = np.empty(count, np.float32), np.empty(count, np.float32)
    colourless, blank = np.empty(count, bool), np.empty(count, bool)
    for start in range(0, count, _CHUNK):
        rows = slice(start, min(start + _CHUNK, count))
        chunk = np.asarray(images[rows])
        lightest, darkest = chunk.max(axis=1), chunk.min(axis=1)
        dark[rows] = (lightest <= DARK).mean(axis=(1, 2))
        bright[rows] = (darkest >= BRIGHT).mean(axis=(1, 2))
        colourless[rows] = (lightest - darkest).mean(axis=(1, 2)) < _COLOURLESS
        grey = shrunk(chunk, GREY_PX)
        blank[rows] = grey.std(axis=(1, 2)) * 255 < _BLANK
        tiny[rows] = _unit(_averaged(grey, TINY_PX).reshape(len(grey), -1))
        tiny[rows][blank[rows]] = 0
        if progress is not None:
            progress(rows.stop, count)
    return Pixels(tiny, dark, bright, colourless, blank)


def shrunk(images: UInt8[np.ndarray, "n 3 s s"], side: int = GREY_PX) -> Float32[np.ndarray, "n t t"]:
    """Grey pictures of ``side`` pixels, 0..1, each pixel the mean of those it stands for."""
    if images.shape[-1] % side:
        raise ValueError(f"the pictures' side must be a multiple of {side} pixels, got {images.shape[-1]}")
    grey = np.tensordot(images.astype(np.float32), _WEIGHTS / 255, axes=(1, 0))
    return _averaged(grey, side)


def _averaged(grey: Float32[np.ndarray, "n h w"], side: int) -> Float32[np.ndarray, "n t t"]:
    block = grey.shape[-1] // side
    return grey.reshape(len(grey), side, block, side, block).mean(axis=(2, 4))


def _unit(rows: Shaped[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    centred = rows - rows.mean(axis=1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    return (centred / np.maximum(length, 1e-6)).astype(np.float32)
