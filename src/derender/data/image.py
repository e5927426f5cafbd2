"""One encoded image in, one uint8 (3, S, S) array out; and images as a caller has them.

Orientation from EXIF is applied; grey, palette and CMYK become RGB; transparent pixels are laid over white.
16-bit images are scaled (65535 becomes 255), never clipped; of an animation the first frame is taken. Colour
profiles are not applied. Images that are not square are cropped to their centre (``fit="crop"``), laid whole
on white ("pad"), squeezed ("stretch"), or given room ("room": their edge continues all around, to a square of
31/24 of the longer side); all are then resized with an antialiased Lanczos filter. A JPEG much larger than
needed is decoded at a reduced scale. Images above ``PIXEL_LIMIT`` and damaged ones raise ``Unreadable``,
nothing else. A box (left, top, right, bottom in pixels of the upright image) cuts out a part first. It is
moved and shrunk as far as needed to lie inside the image.

A caller gives a path, a Pillow image, a NumPy array, a tensor, or several of these. Arrays of bytes, or of
numbers in 0..1, may be (H, W, 3), (3, H, W) or grey (H, W). Batches are (N, H, W, 3) or (N, 3, H, W).
"""

import importlib
import io
import logging
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from PIL import ExifTags, Image
from PIL.Image import Resampling, Transpose
from torch import Tensor

from derender.storage.bounded import FILE_LIMIT_BYTES, read_bounded
from derender.storage.places import nearest_sibling, require_known

GivenImages: TypeAlias = str | Path | Image.Image | np.ndarray | Tensor | Sequence[Any]

READER_VERSION = 1  # goes up where a file would decode to other pixels: cached images are made again

FITS = ("crop", "pad", "stretch", "room")  # what becomes of an image that is not square
ROOM = 31 / 24  # a tight crop of a face, 84 x 96, becomes 124 x 124
PIXEL_LIMIT = 170_000_000  # above it nothing is decoded (Pillow itself refuses images at 179 million)

_LARGE_PIXELS, _MOST_BYTES_A_PIXEL = 20_000_000, 24
LARGE_BYTES, HEAD_BYTES = 64 << 20, 1 << 16
one_large_image_at_a_time = threading.RLock()

_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF", "PPM", "AVIF", "HEIF")
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_BACKGROUND = (255, 255, 255)
_UPRIGHT = (  # by orientation, from 2 on
    *(Transpose.FLIP_LEFT_RIGHT, Transpose.ROTATE_180, Transpose.FLIP_TOP_BOTTOM, Transpose.TRANSPOSE),
    *(Transpose.ROTATE_270, Transpose.TRANSVERSE, Transpose.ROTATE_90),
)

# What readers of images and archives raise on damaged or hostile files (found by feeding them such files).
DECODER_ERRORS = (
    *(OSError, ValueError, SyntaxError, EOFError, LookupError, TypeError, AttributeError, ArithmeticError),
    *(MemoryError, RuntimeError, struct.error, zlib.error, BadZipFile, Image.DecompressionBombError),
)


class Unreadable(ValueError):
    """This image cannot be used; the message is the reason in a few words."""


def read_image(
    image: str | Path | bytes, image_size: int, *, fit: str = "crop"
) -> UInt8[np.ndarray, "3 s s"]:
    """Read one image, from a file or from its encoded bytes, as RGB of ``image_size`` x ``image_size``.

    A file that does not exist raises FileNotFoundError; one that is no usable image raises ``Unreadable``.
    """
    require_known("fit", fit, FITS)
    name = "the given bytes" if isinstance(image, bytes) else str(image)
    try:
        encoded = image if isinstance(image, bytes) else read_bounded(Path(image), FILE_LIMIT_BYTES)
        with quiet_pillow():
            return decode(encoded, image_size, fit)
    except ValueError as problem:
        raise Unreadable(f"{name} cannot be used as an image: {problem}") from problem


def decode(
    encoded: bytes, image_size: int, fit: str = "crop", box: Float32[np.ndarray, "4"] | None = None,
    pixel_limit: int = PIXEL_LIMIT,
) -> UInt8[np.ndarray, "3 s s"]:  # fmt: skip
    """Decode one image; ``Unreadable`` if that cannot be done. Wrap many calls in ``quiet_pillow``."""
    if box is not None and not (np.isfinite(box).all() and (box[2:] > box[:2]).all()):
        raise Unreadable("no usable box is known for the part to read")
    with _opened(encoded, pixel_limit) as opened:
        width = opened.width
        short, long = sorted(opened.size if box is None else (box[2:] - box[:2]).tolist())
        kept = long if fit in ("pad", "room") else short
        if opened.format in ("JPEG", "MPO") and kept >= 4 * image_size:
            scale = 2 * image_size / kept  # the decoder takes 1/2, 1/4 or 1/8, never less than this
            opened.draft(None, (int(width * scale), int(opened.height * scale)))
        large = opened.width * opened.height > _LARGE_PIXELS
        with one_large_image_at_a_time if large else nullcontext():
            image = upright_rgb(opened)
            if box is not None:
                image = _cut(image, box * (opened.width / width))
            return np.ascontiguousarray(np.asarray(fit_square(image, image_size, fit)).transpose(2, 0, 1))


def decode_whole(encoded: bytes, pixel_limit: int = PIXEL_LIMIT) -> UInt8[np.ndarray, "h w 3"]:
    """Decode one image at its own size; ``Unreadable`` if that cannot be done."""
    with _opened(encoded, pixel_limit) as opened, one_large_image_at_a_time:
        return np.array(upright_rgb(opened))


@contextmanager
def _opened(encoded: bytes, pixel_limit: int) -> Iterator[Image.Image]:
    """An image's header, read; whatever goes wrong within is ``Unreadable``."""
    try:
        with Image.open(io.BytesIO(encoded), formats=_known_formats()) as opened:
            width, height = opened.size
            if width * height > pixel_limit:
                raise Unreadable(f"{width} x {height} is more than {pixel_limit // 10**6} million pixels")
            yield opened
    except Unreadable:
        raise
    except Image.UnidentifiedImageError as problem:
        if encoded[4:8] == b"ftyp" and encoded[8:12] in _HEIC_BRANDS:
            missing = "HEIF" not in _known_formats()
            why = "pip install pillow-heif, or save it as JPEG" if missing else "damaged; copy it again"
            raise Unreadable(f"a HEIC photograph: {why}") from problem
        raise Unreadable("not an image in a known format") from problem
    except DECODER_ERRORS as problem:
        why = " ".join(str(problem).split()) or type(problem).__name__
        raise Unreadable(f"damaged or unsupported ({why})") from problem


def refuse_by_header(head: bytes, size: int) -> None:
    """Raise ``Unreadable`` where the first bytes of an image of ``size`` bytes show that it is not usable."""
    if head[:4] not in (b"II*\0", b"MM\0*"):  # TIFF files may keep their header at the end
        with _opened(head, PIXEL_LIMIT) as opened:
            if size > LARGE_BYTES + _MOST_BYTES_A_PIXEL * opened.width * opened.height:
                raise Unreadable(f"{size >> 20:,} MiB of {opened.width} x {opened.height} pixels")


def upright_rgb(opened: Image.Image) -> Image.Image:
    """An opened image of any of Pillow's modes as 8-bit RGB, turned as its EXIF orientation says."""
    deep = opened.mode == "F" or opened.mode.startswith("I")
    image = _from_high_depth(opened) if deep else opened
    if image.mode in ("RGBA", "RGBa", "LA", "La", "PA") or "transparency" in image.info:
        layered = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", layered.size, (*_BACKGROUND, 255)), layered)
    return _upright(image.convert("RGB"), opened)


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Silence Pillow's warnings about single files: what matters of them becomes ``Unreadable``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        warnings.filterwarnings("ignore", module=r"PIL\b.*")
        yield


@cache
def _known_formats() -> tuple[str, ...]:
    """Our formats that this Pillow opens (AVIF may lack; HEIC needs pillow-heif), never PostScript."""
    logging.getLogger("PIL").addHandler(logging.NullHandler())  # what is wrong with a file is raised, too
    Image.init()
    with suppress(ImportError):
        importlib.import_module("pillow_heif").register_heif_opener()
    return tuple(form for form in _FORMATS if form in Image.OPEN)


def _cut(image: Image.Image, box: Float32[np.ndarray, "4"]) -> Image.Image:
    """The part in the box, to the nearest pixel; a square box stays square."""
    sides = np.maximum(1, np.round(box[2:] - box[:2])).astype(int)
    sides = np.minimum(sides, min(image.size) if sides[0] == sides[1] else image.size)
    left, top = np.clip(np.round((box[:2] + box[2:] - sides) / 2).astype(int), 0, image.size - sides)
    return image.crop((int(left), int(top), int(left + sides[0]), int(top + sides[1])))


def _upright(image: Image.Image, opened: Image.Image) -> Image.Image:
    """Turn the image as the EXIF orientation of the ``opened`` file says; damaged EXIF counts as none."""
    if opened.format == "JPEG" and "exif" not in opened.info and "xmp" not in opened.info:
        return image
    try:
        orientation = opened.getexif().get(ExifTags.Base.Orientation)
    except DECODER_ERRORS:
        return image
    if not isinstance(orientation, int) or not 2 <= orientation <= 8:
        return image
    return image.transpose(_UPRIGHT[orientation - 2])


def upright_size(encoded: bytes) -> tuple[int, int]:
    """Width and height, turned as the EXIF orientation says; nothing is decoded. Raises DECODER_ERRORS."""
    with Image.open(io.BytesIO(encoded)) as opened:
        return _upright(Image.new("1", opened.size), opened).size


def _from_high_depth(image: Image.Image) -> Image.Image:
    """Grey images of 16 bits (white is 65535) or of floats (white is 1) as 8-bit grey."""
    values = np.asarray(image)
    if values.dtype.kind == "f":
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
            raise Unreadable("floating-point image with values outside 0..1")
        return Image.fromarray(np.round(values * 255).astype(np.uint8))
    if values.min() < 0 or values.max() > 65535:
        raise Unreadable("integer image with values outside 0..65535")
    return Image.fromarray(((values.astype(np.uint32) + 128) // 257).astype(np.uint8))


def fit_square(
    image: Image.Image, image_size: int, fit: str, resample: Resampling = Resampling.LANCZOS,
    background: int | tuple[int, ...] = _BACKGROUND,
) -> Image.Image:  # fmt: skip
    """Crop, pad or squeeze to a square of the wanted size; maps of classes take NEAREST and a class."""
    size, (width, height) = (image_size, image_size), image.size
    if image.size == size:
        return image
    if fit == "pad":
        scale = image_size / max(width, height)
        inner = (max(1, round(width * scale)), max(1, round(height * scale)))
        square = Image.new(image.mode, size, background)
        resized = image.resize(inner, resample, reducing_gap=3.0)
        square.paste(resized, ((image_size - inner[0]) // 2, (image_size - inner[1]) // 2))
        return square
    if fit == "room":
        side = round(max(width, height) * ROOM)
        margins = [((side - length) // 2, (side - length + 1) // 2) for length in (height, width)]
        values = np.asarray(image)
        image = Image.fromarray(np.pad(values, [*margins, (0, 0)][: values.ndim], mode="edge"))
    if fit == "crop" and width != height:
        side = min(width, height)
        left, top = (width - side) // 2, (height - side) // 2
        image = image.crop((left, top, left + side, top + side))
    return image.resize(size, resample, reducing_gap=3.0)


def as_batch(
    images: GivenImages, size: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "n 3 size size"]:
    """Images for a model of side ``size``, in 0..1.

    A tensor (N, 3, S, S) of numbers is returned as it is, on its own device. Files, Pillow images and arrays
    are cropped to their centre square and resized (Lanczos) where they have another size.

    Raises:
        ValueError: values outside 0..1, or an array that is no image; the message says how to convert it.
        FileNotFoundError: there is no such file.
    """
    if torch.is_tensor(images) and images.ndim == 4 and images.is_floating_point() and images.shape[-1] != 3:
        check_images(images, size)
        refuse_values(images)
        return images.float()
    return torch.from_numpy(np.stack(_squares(images, size))).to(device).float() / 255


def _squares(images: GivenImages, size: int) -> list[UInt8[np.ndarray, "3 s s"]]:
    """Every image as models take it; a file as it is read from a folder."""
    if isinstance(images, (str, Path)):
        return [read_image(images, size)]
    if isinstance(images, (list, tuple)) and images:
        return [square for image in images for square in _squares(image, size)]
    fitted = [fit_square(Image.fromarray(photo), size, "crop") for photo in as_photos(images)]
    return [np.asarray(one).transpose(2, 0, 1) for one in fitted]


def as_photos(images: GivenImages) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Every image at its own size, as bytes; errors as `as_batch` raises them."""
    if isinstance(images, (str, Path)):
        return [read_photo(images)]
    if isinstance(images, Image.Image):
        return [np.array(upright_rgb(images))]
    if isinstance(images, Tensor):
        images = (images.float() if images.dtype == torch.bfloat16 else images).detach().cpu().numpy()
    if not isinstance(images, np.ndarray):
        if not isinstance(images, Sequence) or not images:
            expected = "a path, a Pillow image, an array, a tensor or a list of them"
            raise TypeError(f"expected {expected}, got {images!r:.80}")
        return [photo for image in images for photo in as_photos(image)]
    shape = images.shape
    batch = np.repeat(images[..., None], 3, axis=-1) if images.ndim == 2 else images
    batch = batch[None] if batch.ndim == 3 else batch
    if batch.ndim == 4 and batch.shape[-1] != 3:
        batch = batch.transpose(0, 2, 3, 1)
    if batch.ndim != 4 or batch.shape[-1] != 3 or not batch.size:
        raise ValueError(f"an array of shape {shape} is no image: give (H, W, 3), (3, H, W) or a batch")
    if batch.dtype != np.uint8:
        if batch.dtype.kind != "f":
            raise ValueError(f"images must be uint8 or numbers in 0..1, got {images.dtype}: convert them")
        refuse_values(batch)
        batch = np.rint(np.clip(batch, 0, 1) * 255).astype(np.uint8)
    return [np.ascontiguousarray(image) for image in batch]


def read_photo(path: str | Path, pixel_limit: int = PIXEL_LIMIT) -> UInt8[np.ndarray, "h w 3"]:
    """One image file at its own size, upright, as RGB; ``Unreadable`` says what is wrong with it."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist{nearest_sibling(path)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name images, such as {path / '*.jpg'}")
    try:
        with quiet_pillow():
            return decode_whole(read_bounded(path, FILE_LIMIT_BYTES), pixel_limit)
    except ValueError as problem:
        raise Unreadable(f"{path} cannot be used as an image: {problem}") from problem


def refuse_values(images: Tensor | np.ndarray) -> None:
    """Numbers that are not finite or not in 0..1 are an error; not looked for on devices that would wait."""
    if isinstance(images, Tensor):
        if images.device.type != "cpu" or torch.compiler.is_compiling():
            return
        images = images.detach().float().numpy()
    if images.size == 0:
        return
    low, high = float(images.min()), float(images.max())
    if not np.isfinite([low, high]).all():
        first = int(np.isfinite(images.reshape(len(images), -1)).all(axis=1).argmin())
        which = f"image {first} of {len(images)}"
        raise ValueError(f"{which} holds values that are not finite: give numbers in 0..1")
    if low < -1e-3 or high > 1 + 1e-3:
        fix = "divide by 255" if high > 2 else "add 1 and halve" if low >= -1.001 else "rescale them"
        raise ValueError(f"images hold values from {low:.3g} to {high:.3g}, not in 0..1: {fix}")


def check_images(images: Tensor, size: int) -> None:
    """Images of another shape than (N, 3, size, size), or of whole numbers, are an error."""
    if images.ndim != 4 or images.shape[1:] != (3, size, size):
        fix = f"read them with derender.data.read_images(..., image_size={size}) or resize them"
        shape = tuple(images.shape)
        raise ValueError(f"this model takes images of shape (N, 3, {size}, {size}), got {shape}: {fix}")
    if not images.is_floating_point():
        raise ValueError(f"images must be floating point in 0..1, got {images.dtype}: divide uint8 by 255")
