"""One image in, RGB of the wanted size out: every mode has its meaning, every damage its reason."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import noise
from tests.trust.hostile_files import png_chunk as chunk

from derender.data import image as module
from derender.data import read_image
from derender.data.image import FITS, Unreadable, decode

RAMP = np.linspace(0, 255, 12).astype(np.uint8)[None, :].repeat(12, 0)


def flat(colour: tuple[int, ...] | int | float, mode: str, size: tuple[int, int] = (16, 16)) -> Image.Image:
    return Image.new(mode, size, colour)


def test_rgb_of_the_right_size_is_untouched_in_bytes_and_in_a_file(encoded, tmp_path):
    array = noise(0)
    np.testing.assert_array_equal(read_image(encoded(array), 12), array.transpose(2, 0, 1))
    (tmp_path / "a.png").write_bytes(encoded(array))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", 8), read_image(encoded(array), 8))
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        read_image(tmp_path / "gone.png", 16)


GREEN = flat((10, 200, 30), "RGB").convert("P", palette=Image.Palette.ADAPTIVE)
MODES = {
    "grey": (flat(100, "L"), "PNG", (100, 100, 100)),
    "bilevel": (flat(1, "1"), "PNG", (255, 255, 255)),
    "palette": (GREEN, "PNG", (10, 200, 30)),
    "opaque": (flat((200, 100, 0, 255), "RGBA"), "PNG", (200, 100, 0)),
    "clear": (flat((200, 100, 0, 0), "RGBA"), "PNG", (255, 255, 255)),
    "translucent": (flat((200, 100, 0, 51), "RGBA"), "PNG", (244, 224, 204)),
    "grey-alpha": (flat((100, 0), "LA"), "PNG", (255, 255, 255)),
    "cmyk": (flat((0, 255, 255, 0), "CMYK"), "TIFF", (255, 0, 0)),
    "cmyk-jpeg": (flat((0, 255, 255, 0), "CMYK"), "JPEG", (254, 0, 0)),
    "float": (flat(0.5, "F"), "TIFF", (128, 128, 128)),
    "ycbcr": (flat((82, 90, 240), "YCbCr"), "JPEG", (239, 15, 14)),
}


@pytest.mark.parametrize(("picture", "form", "expected"), MODES.values(), ids=MODES)
def test_modes(encoded, picture, form, expected):
    options = {"quality": 100} if form == "JPEG" else {}
    pixels = read_image(encoded(picture, form, **options), 16)
    np.testing.assert_allclose(pixels[:, 8, 8].astype(int), expected, atol=2 if form == "JPEG" else 0)


@pytest.mark.parametrize("form", ["PNG", "TIFF", "PPM"])
def test_sixteen_bits_are_scaled_not_clipped(encoded, form):
    picture = Image.fromarray(RAMP.astype(np.uint16) * 257)
    if form == "PPM":
        picture = picture.convert("I")  # which every version of Pillow writes as 16 bits there
    np.testing.assert_array_equal(read_image(encoded(picture, form), 12), np.stack([RAMP] * 3))


def png(width: int, height: int, bits: int, colour_type: int, rows: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def test_sixteen_bit_colour():
    row = b"\0" + b"".join(struct.pack(">HHH", 0x2010, 0x8020, 0xFFFF) for _ in range(4))
    np.testing.assert_array_equal(read_image(png(4, 4, 16, 2, row * 4), 4)[:, 0, 0], (0x20, 0x80, 0xFF))


@pytest.mark.parametrize(
    ("value", "mode", "message"),
    [
        *((value, "F", r"outside 0\.\.1") for value in (-1.0, 2.0, float("nan"))),
        (70_000, "I", r"outside 0\.\.65535"),
    ],
)
def test_numbers_outside_their_range_are_refused(encoded, value, mode, message):
    with pytest.raises(Unreadable, match=message):
        read_image(encoded(flat(value, mode), "TIFF"), 16)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("form", "options"),
    [("JPEG", {"quality": 95, "subsampling": 0}), ("PNG", {}), ("TIFF", {}), ("WEBP", {"lossless": True})],
)
def test_exif_orientation_is_applied(encoded, orientation, form, options):
    """An image stored turned, with the tag that says so, reads as the upright one."""
    upright = Image.new("RGB", (16, 16), "white")
    upright.paste("black", (0, 0, 8, 8))
    upright.paste("red", (8, 0, 16, 8))
    undo = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # Pillow's transpositions from upright to stored
    stored = upright if orientation == 1 else upright.transpose(Image.Transpose(undo[orientation]))
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = read_image(encoded(stored, form, exif=exif, **options), 16)
    corners = pixels[:, [2, 2, 13, 13], [2, 13, 2, 13]].T.astype(int)
    np.testing.assert_allclose(corners, [(0, 0, 0), (255, 0, 0), (255,) * 3, (255,) * 3], atol=12)


@pytest.mark.parametrize("form", ["GIF", "WEBP", "PNG", "TIFF"])
def test_first_frame_of_an_animation(encoded, form):
    first, second = flat((255, 0, 0), "RGB"), flat((0, 0, 255), "RGB")
    options = {"lossless": True} if form == "WEBP" else {}
    content = encoded(first, form, save_all=True, append_images=[second], **options)
    np.testing.assert_array_equal(read_image(content, 16)[:, 0, 0], (255, 0, 0))


def striped(width: int, height: int) -> Image.Image:
    """Three parts along the long side: red, green, blue."""
    places = np.arange(max(width, height)) * 3 // max(width, height)
    colours = (np.eye(3)[places] * 255).astype(np.uint8)
    wide = np.broadcast_to(colours[None], (min(width, height), len(places), 3))
    return Image.fromarray(np.ascontiguousarray(wide if width > height else wide.transpose(1, 0, 2)))


@pytest.mark.parametrize("size", [(36, 12), (12, 36), (90, 30)])
def test_crop_keeps_the_centre_and_pad_and_stretch_all_of_it(encoded, size):
    fits, file = ("crop", "pad", "stretch"), encoded(striped(*size))
    cropped, padded, stretched = (read_image(file, 12, fit=fit) for fit in fits)
    assert (cropped == np.array([0, 255, 0])[:, None, None]).mean() > 0.99
    if size[0] < size[1]:
        padded, stretched = padded.transpose(0, 2, 1), stretched.transpose(0, 2, 1)
    assert (padded[:, :4] == 255).all() and (padded[:, 8:] == 255).all()
    for picture, row in ((padded, 6), (stretched, 2)):
        np.testing.assert_allclose(picture[:, row, [1, 6, 10]].T, 255 * np.eye(3), atol=3)


def test_room_continues_the_edge_all_around(encoded):
    picture = striped(84, 96)
    pixels, inside = read_image(encoded(picture), 124, fit="room"), np.asarray(picture).transpose(2, 0, 1)
    np.testing.assert_array_equal(pixels[:, 14:110, 20:104], inside)
    np.testing.assert_array_equal(pixels[:, :14, 20:104], np.repeat(inside[:, :1], 14, axis=1))
    np.testing.assert_array_equal(pixels[:, 14:110, 104:], np.repeat(inside[:, :, -1:], 20, axis=2))


def test_unknown_fit_names_the_nearest(encoded):
    message = r"unknown fit 'crops'; did you mean 'crop'\?: choose crop, pad, stretch or room"
    with pytest.raises(ValueError, match=message):
        read_image(encoded(0), 8, fit="crops")


def test_resizing_is_antialiased(encoded):
    """A fine checkerboard shrinks to grey; picking single pixels would give black or white."""
    board = ((np.indices((256, 256)).sum(0) % 2) * 255).astype(np.uint8)
    assert np.abs(read_image(encoded(board), 16).astype(int) - 128).max() <= 3


def test_reduced_jpeg_decoding_agrees_with_full(encoded, monkeypatch):
    ramp = np.linspace(0, 255, 1024).astype(np.uint8)
    channels = ramp[None].repeat(768, 0), ramp[:768, None].repeat(1024, 1), np.full((768, 1024), 90, np.uint8)
    content = encoded(np.stack(channels, 2), "JPEG", quality=95)
    for fit in FITS:
        reduced = read_image(content, 32, fit=fit).astype(int)
        with monkeypatch.context() as patch:
            patch.setattr("PIL.JpegImagePlugin.JpegImageFile.draft", lambda *_: None)
            full = read_image(content, 32, fit=fit).astype(int)
        assert np.abs(reduced - full).max() <= 3


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (2, 3)])
@pytest.mark.parametrize("fit", FITS)
def test_tiny_and_narrow_images(encoded, size, fit):
    assert read_image(encoded(flat((9, 9, 9), "RGB", size)), 8, fit=fit).shape == (3, 8, 8)


def test_huge_images_are_refused_before_decoding_and_large_ones_raise_no_warning(encoded, monkeypatch):
    for side in (30_000, 13_100):
        with pytest.raises(Unreadable, match=f"{side} x {side} is more than 170 million|exceeds limit"):
            read_image(png(side, side, 8, 2, b""), 16)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 3_000)
    monkeypatch.setattr(module, "_LARGE_PIXELS", 1_000)
    assert read_image(encoded(flat((5, 6, 7), "RGB", (64, 64))), 16)[:, 0, 0].tolist() == [5, 6, 7]


def test_damage_has_a_reason(encoded, monkeypatch):
    content = encoded(noise(0, 200, 200), "JPEG")
    with pytest.raises(Unreadable, match=r"the given bytes cannot be used as an image: damaged .*truncated"):
        read_image(content[: len(content) // 2], 16)
    for none in (b"", b"text", b"\xff\xd8\xff", b"<svg></svg>", b"%!PS-Adobe-3.0 EPSF-3.0\n"):
        with pytest.raises(Unreadable, match=r"not an image in a known format|damaged"):
            read_image(none, 16)
    known = tuple(form for form in module._known_formats() if form != "HEIF")
    monkeypatch.setattr(module, "_known_formats", lambda: known)
    with pytest.raises(Unreadable, match=r"HEIC photograph: pip install pillow-heif"):
        read_image(b"\0\0\0\x18ftypheic" + bytes(40), 16)


def box(*sides: float) -> np.ndarray:
    return np.array(sides, np.float32)


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize(
    ("sides", "inside"),
    [
        *(2 * [sides] for sides in [(3, 5, 23, 25), (0, 0, 40, 30), (1, 2, 31, 12)]),
        ((2.4, 4.6, 22.4, 24.6), (2, 5, 22, 25)),
        ((-5, -7, 15, 13), (0, 0, 20, 20)),
        ((30, 20, 50, 40), (20, 10, 40, 30)),
        ((-20, -30, 60, 50), (5, 0, 35, 30)),
        ((-10, 5, 70, 15), (0, 5, 40, 15)),
    ],
)
def test_a_box_is_moved_and_shrunk_into_the_image_and_the_same_as_cutting_first(encoded, fit, sides, inside):
    whole, (left, top, right, bottom) = noise(1, width=40, height=30), inside
    expected = decode(encoded(np.ascontiguousarray(whole[top:bottom, left:right])), 12, fit)
    assert (decode(encoded(whole), 12, fit, box(*sides)) == expected).all()


def test_a_box_in_a_turned_image_is_in_upright_pixels(encoded):
    upright, exif = Image.fromarray(noise(4, width=40, height=30)), Image.Exif()
    exif[0x0112] = 6  # stored lying, to be turned by 90 degrees
    turned = encoded(upright.transpose(Image.Transpose.ROTATE_90), exif=exif)
    sides = box(10, 2, 30, 22)
    assert (decode(turned, 9, "crop", sides) == decode(encoded(upright), 9, "crop", sides)).all()


def test_a_box_holds_where_the_jpeg_is_decoded_at_a_reduced_scale(encoded):
    """A ramp says where the pixels came from: the mean of each column is its place in the image."""
    ramp = np.broadcast_to(np.linspace(0, 255, 1024)[None, :, None], (512, 1024, 3)).astype(np.uint8)
    jpeg = encoded(ramp, "JPEG", quality=95)
    part = decode(jpeg, 16, "crop", box(256, 100, 640, 484)).mean(axis=(0, 1))
    centres = 256 + (np.arange(16) + 0.5) * 384 / 16
    assert np.abs(part - centres / 1024 * 255).max() < 1.5
    small = decode(jpeg, 16, "crop", box(512, 100, 528, 116)).mean()
    assert abs(small - 520 / 1024 * 255) < 1.5
