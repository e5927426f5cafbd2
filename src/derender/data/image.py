"""One encoded image in, one uint8 (3, S, S) array out.

Orientation from EXIF is applied; grey, palette and CMYK become RGB; transparent pixels are laid over white;
16-bit images are scaled (65535 becomes 255), never clipped; of an animation the first frame is taken.
Colour profiles are not applied. Images that are not square are cropped to their centre (``fit="crop"``),
laid whole on white ("pad"), or squeezed ("stretch"); all are then resized with an antialiased Lanczos
filter. A JPEG much larger than needed is decoded at a reduced scale. Images above ``PIXEL_LIMIT`` and
damaged ones raise ``Unreadable``, nothing else. A box (left, top, right, bottom in pixels of the upright
image) cuts out a part first; it is moved and shrunk as far as needed to lie inside the image.
"""

import io
import logging
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from derender.data.names import suggestion
from derender.data.source import Source, read_bounded

READER_VERSION = 1
"""Goes up whenever the same file would decode to other pixels, so that cached images are made again."""

FITS = ("crop", "pad", "stretch")
"""What becomes of an image that is not square."""

PIXEL_LIMIT = 170_000_000
"""Images with more pixels are refused before a pixel is decoded (Pillow itself refuses at 179 million)."""

_LARGE_PIXELS = 20_000_000
_one_large_image_at_a_time = threading.Lock()

_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF", "PPM", "AVIF")
_BACKGROUND = (255, 255, 255)
_ORIENTATION_TAG = 0x0112
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}

# What Pillow and the libraries under it raise on damaged or hostile files (found by feeding them such files).
DECODER_ERRORS = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


class Unreadable(ValueError):
    """This image cannot be used; the message is the reason in a few words."""


def read_image(
    picture: str | Path | bytes, image_size: int, *, fit: str = "crop"
) -> UInt8[np.ndarray, "3 s s"]:
    """Read one image, from a file or from its encoded bytes, as RGB of ``image_size`` x ``image_size``.

    A file that does not exist raises FileNotFoundError; one that is no usable image raises ``Unreadable``.
    """
    check_fit(fit)
    name = "the given bytes" if isinstance(picture, bytes) else str(picture)
    try:
        encoded = picture if isinstance(picture, bytes) else read_bounded(Path(picture))
        with quiet_pillow():
            return decode(encoded, image_size, fit)
    except ValueError as problem:
        raise Unreadable(f"{name} cannot be used as an image: {problem}") from problem


def check_fit(fit: str) -> None:
    """An unknown ``fit`` is an error that names the known ones."""
    if fit not in FITS:
        raise ValueError(f"unknown fit {fit!r}{suggestion(fit, FITS)} (known: {', '.join(FITS)})")


def decode(
    encoded: bytes,
    image_size: int,
    fit: str = "crop",
    box: Float32[np.ndarray, "4"] | None = None,
    pixel_limit: int = PIXEL_LIMIT,
) -> UInt8[np.ndarray, "3 s s"]:
    """Decode one image; ``Unreadable`` if that cannot be done. Wrap many calls in ``quiet_pillow``."""
    if box is not None and not (np.isfinite(box).all() and (box[2:] > box[:2]).all()):
        raise Unreadable("no usable box is known for the part to read")
    try:
        with Image.open(io.BytesIO(encoded), formats=_known_formats()) as opened:
            width, height = opened.size
            if width * height > pixel_limit:
                raise Unreadable(f"{width} x {height} is more than {pixel_limit // 10**6} million pixels")
            _reduce_while_decoding(opened, image_size, fit, box)
            if box is not None:
                box = box * (opened.size[0] / width)
            if opened.size[0] * opened.size[1] > _LARGE_PIXELS:
                with _one_large_image_at_a_time:
                    return _finish(opened, image_size, fit, box)
            return _finish(opened, image_size, fit, box)
    except Unreadable:
        raise
    except Image.UnidentifiedImageError as problem:
        raise Unreadable("not an image in a known format") from problem
    except DECODER_ERRORS as problem:
        raise Unreadable(f"damaged or unsupported ({problem or type(problem).__name__})") from problem


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Silence Pillow's warnings about single files: what matters of them becomes ``Unreadable``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        warnings.filterwarnings("ignore", module=r"PIL\b.*")
        yield


@cache
def _known_formats() -> tuple[str, ...]:
    """Those of our formats that this build of Pillow opens (AVIF may lack); never PostScript and the like."""
    logging.getLogger("PIL").addHandler(logging.NullHandler())  # what is wrong with a file is raised, too
    Image.init()
    return tuple(form for form in _FORMATS if form in Image.OPEN)


def _reduce_while_decoding(
    opened: Image.Image, image_size: int, fit: str, box: Float32[np.ndarray, "4"] | None
) -> None:
    """Let the JPEG decoder scale by 1/2, 1/4 or 1/8, never below twice the size that is needed."""
    short, long = sorted(opened.size if box is None else (box[2:] - box[:2]).tolist())
    kept = long if fit == "pad" else short
    if opened.format in ("JPEG", "MPO") and kept >= 4 * image_size:
        scale = 2 * image_size / kept
        opened.draft(None, (int(opened.size[0] * scale), int(opened.size[1] * scale)))


def _finish(
    opened: Image.Image, image_size: int, fit: str, box: Float32[np.ndarray, "4"] | None
) -> UInt8[np.ndarray, "3 s s"]:
    picture = upright(_as_rgb(opened), opened)
    if box is not None:
        picture = _cut(picture, box)
    return np.ascontiguousarray(np.asarray(fit_square(picture, image_size, fit)).transpose(2, 0, 1))


def _cut(picture: Image.Image, box: Float32[np.ndarray, "4"]) -> Image.Image:
    """The part in the box, to the nearest pixel; a square box stays square."""
    sides = np.maximum(1, np.round(box[2:] - box[:2])).astype(int)
    sides = np.minimum(sides, min(picture.size)) if sides[0] == sides[1] else np.minimum(sides, picture.size)
    left, top = np.clip(np.round((box[:2] + box[2:] - sides) / 2).astype(int), 0, picture.size - sides)
    return picture.crop((int(left), int(top), int(left + sides[0]), int(top + sides[1])))


def upright(picture: Image.Image, opened: Image.Image) -> Image.Image:
    """Turn the image as the EXIF orientation of the ``opened`` file says; damaged EXIF counts as none."""
    if opened.format == "JPEG" and "exif" not in opened.info and "xmp" not in opened.info:
        return picture
    try:
        orientation = opened.getexif().get(_ORIENTATION_TAG, 1)
    except DECODER_ERRORS:
        return picture
    turn = _UPRIGHT.get(orientation) if isinstance(orientation, int) else None
    return picture if turn is None else picture.transpose(turn)


def upright_size(opened: Image.Image) -> tuple[int, int]:
    """Width and height of an opened file, turned as its EXIF orientation says; nothing is decoded."""
    return upright(Image.new("1", opened.size), opened).size


def opened_image(source: Source, file: str) -> Image.Image:
    """A map or mask as it is stored, decoded; one that cannot be read is an error that names it."""
    try:
        opened = Image.open(io.BytesIO(source.read(file)))
        opened.load()
        return opened
    except DECODER_ERRORS as problem:
        raise ValueError(f"{file} in {source.path} cannot be read: {problem}") from problem


def _as_rgb(picture: Image.Image) -> Image.Image:
    """Any of Pillow's modes as 8-bit RGB."""
    if picture.mode == "RGB" and "transparency" not in picture.info:
        picture.load()
        return picture
    if picture.mode == "F" or picture.mode.startswith("I"):
        return _from_high_depth(picture).convert("RGB")
    if picture.mode in ("RGBA", "RGBa", "LA", "La", "PA") or "transparency" in picture.info:
        layered = picture.convert("RGBA")
        background = Image.new("RGBA", layered.size, (*_BACKGROUND, 255))
        return Image.alpha_composite(background, layered).convert("RGB")
    return picture.convert("RGB")


def _from_high_depth(picture: Image.Image) -> Image.Image:
    """Grey images of 16 bits (white is 65535) or of floats (white is 1) as 8-bit grey."""
    values = np.asarray(picture)
    if values.dtype.kind == "f":
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
            raise Unreadable("floating-point image with values outside 0..1")
        return Image.fromarray(np.round(values * 255).astype(np.uint8))
    if values.min() < 0 or values.max() > 65535:
        raise Unreadable("integer image with values outside 0..65535")
    return Image.fromarray(((values.astype(np.uint32) + 128) // 257).astype(np.uint8))


def fit_square(
    picture: Image.Image,
    image_size: int,
    fit: str,
    resample: Image.Resampling = Image.Resampling.LANCZOS,
    background: int | tuple[int, ...] = _BACKGROUND,
) -> Image.Image:
    """Crop, pad or squeeze to a square of the wanted size; maps of classes take NEAREST and a class."""
    size = (image_size, image_size)
    if picture.size == size:
        return picture
    width, height = picture.size
    if fit == "pad":
        scale = image_size / max(width, height)
        inner = (max(1, round(width * scale)), max(1, round(height * scale)))
        square = Image.new(picture.mode, size, background)
        resized = picture.resize(inner, resample, reducing_gap=3.0)
        square.paste(resized, ((image_size - inner[0]) // 2, (image_size - inner[1]) // 2))
        return square
    if fit == "crop" and width != height:
        side = min(width, height)
        left, top = (width - side) // 2, (height - side) // 2
        picture = picture.crop((left, top, left + side, top + side))
    return picture.resize(size, resample, reducing_gap=3.0)
