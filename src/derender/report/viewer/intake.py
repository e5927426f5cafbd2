"""Bytes from a stranger to pixels: the file's own content decides what it is, never its name or stated type.

The library's one decoder does the work (data/decode.py); here stand only tighter bounds than a data set
needs, and words for a person. Nothing is written anywhere. Leaves out colour profiles, as the decoder does.
"""

import numpy as np
from jaxtyping import UInt8
from PIL.Image import DecompressionBombError

from derender.data import Unreadable, decode, quiet_pillow
from derender.report.viewer.refused import Refused

BODY_LIMIT_BYTES = 20_000_000
PIXEL_LIMIT = 40_000_000
"""Fewer than any decompression bomb needs, more than most cameras take."""

KINDS = "JPEG, PNG, WebP, AVIF, BMP, GIF, TIFF, PPM"


def too_large() -> Refused:
    return Refused(
        413, f"this file is larger than {BODY_LIMIT_BYTES // 10**6} MB: make the picture smaller first"
    )


def pixels_of(encoded: bytes, image_size: int, box: np.ndarray | None = None) -> UInt8[np.ndarray, "3 s s"]:
    """Decode one picture, cut to its centre square; ``Refused`` (413 or 415) if that cannot be done."""
    if len(encoded) > BODY_LIMIT_BYTES:
        raise too_large()
    if not encoded:
        raise Refused(415, f"this file is empty: choose a picture ({KINDS})")
    try:
        with quiet_pillow():
            return decode(encoded, image_size, box=box, pixel_limit=PIXEL_LIMIT)
    except Unreadable as problem:
        if "million pixels" in str(problem) or isinstance(problem.__cause__, DecompressionBombError):
            most = f"{PIXEL_LIMIT // 10**6} million pixels"
            raise Refused(413, f"this picture has more than {most}: make it smaller first") from problem
        reason = _flat(str(problem))
        raise Refused(
            415, f"this file cannot be read: {reason}; whatever its name says, choose a picture ({KINDS})"
        ) from problem


def _flat(text: str) -> str:
    return " ".join(text.split())[:200]
