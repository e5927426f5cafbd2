"""Images that are broken, odd or meant to do harm, made on the spot, and an archive of the kind."""

import os
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms
from tests.data.conftest import encode as encoded

NAMES = ("ÄÖ ß 日本.png", "two\nlines.png", "quote\"'.png", "tab\there.png", "-rf.png", "a" * 240 + ".png")
NAMES += ("<script>.png",)
UNSAFE = ("../outside.png", "/absolute.png", "a/../../outside.png", "C:/windows.png", "..\\back.png")
PNG_HEAD = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Hostile:
    """What was written.

    Attributes:
        folder: where.
        readable: names of files that are images, odd as they may be.
        unreadable: names of files that have to be skipped and named.
    """

    folder: Path
    readable: tuple[str, ...]
    unreadable: tuple[str, ...]


def smooth(seed: int, size: tuple[int, int] = (48, 40)) -> Image.Image:
    """An image that differs with the seed."""
    small = np.random.default_rng(seed).integers(0, 256, (5, 5, 3), dtype=np.uint8)
    return Image.fromarray(small).resize(size)


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_that_says(width: int, height: int) -> bytes:
    """A small PNG file that claims this size; its data would unpack to 10 MB of zeros."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = {b"IHDR": head, b"IDAT": zlib.compress(bytes(10_000_000), 9), b"IEND": b""}
    return PNG_HEAD + b"".join(png_chunk(kind, content) for kind, content in chunks.items())


def png_with_endless_text() -> bytes:
    """A whole PNG whose compressed comment unpacks to 100 MB."""
    whole = encoded(smooth(90))
    text = png_chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(100_000_000), 9))
    return whole[:33] + text + whole[33:]


def float_tiff(value: float) -> bytes:
    values = np.full((20, 20), 0.5, np.float32)
    values[3, 4] = value
    return encoded(Image.fromarray(values), "TIFF")


def odd_pictures() -> dict[str, bytes]:
    """Files that are images, by name."""
    rotated = Image.Exif()
    rotated[0x0112] = 6
    damaged_exif = b"Exif\0\0II*\0\xff\xff\xff\xff" + bytes(20)
    frames = [smooth(number) for number in range(10, 14)]
    animated = {"save_all": True, "append_images": frames[1:]}
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    deep = np.random.default_rng(1).integers(0, 65536, (30, 30)).astype(np.uint16)
    result = {
        "plain.jpg": encoded(smooth(1), "JPEG"),
        "jpeg named.png": encoded(smooth(2), "JPEG"),
        "png named.jpg": encoded(smooth(3)),
        "animated.gif": encoded(frames[0], "GIF", **animated),
        "animated.webp": encoded(smooth(15), "WEBP", **animated),
        "animated.png": encoded(smooth(16), **animated),
        "cmyk.jpg": encoded(smooth(17).convert("CMYK"), "JPEG"),
        "grey.bmp": encoded(smooth(18).convert("L"), "BMP"),
        "bilevel.tif": encoded(smooth(19).convert("1"), "TIFF"),
        "deep.png": encoded(Image.fromarray(deep)),
        "deep.tif": encoded(Image.fromarray(deep // 2), "TIFF"),
        "float.tif": float_tiff(0.25),
        "rotated.jpg": encoded(smooth(20), "JPEG", exif=rotated),
        "damaged exif.jpg": encoded(smooth(21), "JPEG", exif=damaged_exif),
        "profile.png": encoded(smooth(22), icc_profile=profile),
        "damaged profile.png": encoded(smooth(23), icc_profile=b"nonsense"),
        "palette.gif": encoded(smooth(24).convert("P"), "GIF", transparency=3),
        "transparent.png": encoded(smooth(25).convert("RGBA")),
        "one pixel.png": encoded(smooth(26, (1, 1))),
        "wide.png": encoded(smooth(27, (30_000, 10))),
        "tall.jpg": encoded(smooth(28, (10, 30_000)), "JPEG"),
    }
    return {**result, **{name: encoded(smooth(40 + row)) for row, name in enumerate(NAMES)}}


def broken_pictures(steps: int = 16) -> dict[str, bytes]:
    """Files that are no usable images, by name; cut off after every ``1/steps`` of five formats."""
    result = {
        "empty.png": b"",
        "text.jpg": b"this is a letter",
        "page.png": b"<html><script>alert(1)</script></html>",
        "postscript.jpg": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n",
        "zeros.jpg": bytes(5_000),
        "nan.tif": float_tiff(float("nan")),
        "infinite.tif": float_tiff(float("inf")),
        "negative.tif": float_tiff(-1.0),
        "bomb.png": png_that_says(60_000, 60_000),
        "bomb below the limit.png": png_that_says(13_000, 13_000),
        "no size.png": png_that_says(0, 0),
        "endless text.png": png_with_endless_text(),
    }
    jpeg = encoded(smooth(60, (300, 200)), "JPEG", quality=95)
    whole = {"jpg": jpeg, "png": encoded(smooth(61, (90, 70))), "bmp": encoded(smooth(62, (30, 20)), "BMP")}
    whole |= {"tif": encoded(smooth(63, (60, 40)), "TIFF"), "webp": encoded(smooth(64, (90, 70)), "WEBP")}
    for kind, content in whole.items():
        for step in range(1, steps):
            result[f"cut {step:02d} of {steps}.{kind}"] = content[: len(content) * step // steps]
    return result


def write_hostile(folder: Path, steps: int = 16) -> Hostile:
    """Write all of it to a folder, with links that lead nowhere or in circles, a pipe and a closed file."""
    folder.mkdir(parents=True)
    odd, broken = odd_pictures(), broken_pictures(steps)
    for name, content in {**odd, **broken}.items():
        (folder / name).write_bytes(content)
    (folder / "to itself.png").symlink_to("to itself.png")
    (folder / "to nowhere.png").symlink_to("gone.png")
    (folder / "round").symlink_to(folder, target_is_directory=True)
    (folder / "folder.png").mkdir()
    os.mkfifo(folder / "pipe.png")
    special = ["to itself.png", "to nowhere.png", "pipe.png"]
    if os.geteuid():  # root may read anything
        (folder / "closed.png").write_bytes(encoded(smooth(70)))
        (folder / "closed.png").chmod(0)
        special.append("closed.png")
    (folder / os.fsdecode(b"not utf8 \xff.png")).write_bytes(encoded(smooth(71)))
    return Hostile(folder, (*odd, "not utf8 \\xff.png"), (*broken, *special))


def write_hostile_zip(file: Path) -> Path:
    """A zip with unsafe names, a symbolic link, an encrypted member and one that claims a terabyte."""
    file.parent.mkdir(parents=True, exist_ok=True)
    link = zipfile.ZipInfo("link.png")
    link.create_system, link.external_attr = 3, 0o120777 << 16
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(4):
            archive.writestr(f"good/{number}.png", encoded(smooth(81 + number)))
        for name in (*UNSAFE, "encrypted.png", "huge.png"):
            archive.writestr(name, encoded(smooth(80)))
        archive.writestr(link, "/etc/passwd")
    content = bytearray(file.read_bytes())
    ends = map(content.rfind, (b"encrypted.png", b"huge.png"))
    encrypted, huge = (content.rfind(b"PK\x01\x02", 0, end) for end in ends)
    content[encrypted + 8] |= 1
    content[huge + 24 : huge + 28] = struct.pack("<I", (1 << 32) - 2)
    file.write_bytes(content)
    return file


def named_in(message: str, names: tuple[str, ...]) -> list[str]:
    """The names that are not told of; white space within them counts as one space."""
    flat = " ".join(message.split())
    return [name for name in names if " ".join(name.split()) not in flat]
