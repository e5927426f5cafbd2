"""Sizes and shapes of the files themselves, read from their headers; nothing is decoded.

A sample, evenly spaced in the sorted list, stands for the whole. Leaves out streams, whose files cannot be
asked for by name.
"""

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image

from derender.data.image import DECODER_ERRORS, quiet_pillow
from derender.data.source import Source

SAMPLE = 1_000


@dataclass(frozen=True)
class Originals:
    """Sizes of a sample of files, in pixels, as stored (EXIF orientation not applied).

    Attributes:
        sampled: how many headers were read.
        median_short, smallest_short, largest_long: short and long sides.
        smaller: share of files whose short side is below ``image_size``, 0..1.
        oblong: share of files whose sides differ by more than a quarter, 0..1.
        image_size: what ``smaller`` is about.
    """

    sampled: int
    median_short: int
    smallest_short: int
    largest_long: int
    smaller: float
    oblong: float
    image_size: int


def measure_originals(
    source: Source, files: tuple[str, ...], image_size: int, sample: int = SAMPLE
) -> Originals | None:
    """Read the headers of at most ``sample`` files; None if none of them has a readable one."""
    rows = np.unique(np.linspace(0, len(files) - 1, min(sample, len(files))).astype(int))
    with quiet_pillow():
        sizes = [size for row in rows if (size := _size(source, files[row])) is not None]
    if not sizes:
        return None
    short, long = np.array([sorted(size) for size in sizes]).T
    return Originals(
        sampled=len(sizes),
        median_short=int(np.median(short)),
        smallest_short=int(short.min()),
        largest_long=int(long.max()),
        smaller=float((short < image_size).mean()),
        oblong=float((long > 1.25 * short).mean()),
        image_size=image_size,
    )


def _size(source: Source, file: str) -> tuple[int, int] | None:
    try:
        with Image.open(io.BytesIO(source.read(file))) as opened:
            return opened.size
    except DECODER_ERRORS:
        return None
