"""One image in, RGB of the wanted size out: every mode has its meaning, every damage its reason."""

import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from derender.data import image as module
from derender.data import read_image
from derender.data.image import FITS, Unreadable

MODE_NAMES = ["grey", "bilevel", "palette", "opaque", "clear", "translucent", "grey-alpha"]
MODE_NAMES += ["cmyk", "cmyk-jpeg", "float", "ycbcr"]
RAMP = np.linspace(0, 255, 12).astype(np.uint8)[None, :].repeat(12, 0)


def flat(colour: tuple[int, ...] | int, mode: str, size: tuple[int, int] = (16, 16)) -> Image.Image:
    return Image.new(mode, size, colour)


def test_rgb_of_the_right_size_is_untouched(encoded):
    array = np.random.default_rng(0).integers(0, 256, (12, 12, 3), dtype=np.uint8)
    np.testing.assert_array_equal(read_image(encoded(array), 12), array.transpose(2, 0, 1))


def test_bytes_and_file_agree(encoded, tmp_path):
    (tmp_path / "a.png").write_bytes(encoded(3))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", 8), read_image(encoded(3), 8))


@pytest.mark.parametrize(
    ("picture", "form", "expected"),
    [
        (flat(100, "L"), "PNG", (100, 100, 100)),
        (flat(1, "1"), "PNG", (255, 255, 255)),
        (flat((10, 200, 30), "RGB").convert("P", palette=Image.Palette.ADAPTIVE), "PNG", (10, 200, 30)),
        (flat((200, 100, 0, 255), "RGBA"), "PNG", (200, 100, 0)),
        (flat((200, 100, 0, 0), "RGBA"), "PNG", (255, 255, 255)),
        (flat((200, 100, 0, 51), "RGBA"), "PNG", (244, 224, 204)),
        (flat((100, 0), "LA"), "PNG", (255, 255, 255)),
        (flat((0, 255, 255, 0), "CMYK"), "TIFF", (255, 0, 0)),
        (flat((0, 255, 255, 0), "CMYK"), "JPEG", (254, 0, 0)),
        (flat(0.5, "F"), "TIFF", (128, 128, 128)),
        (flat((82, 90, 240), "YCbCr"), "JPEG", (239, 15, 14)),
    ],
    ids=MODE_NAMES,
)
def test_modes(encoded, picture, form, expected):
    options = {"quality": 100} if form == "JPEG" else {}
    pixels = read_image(encoded(picture, form, **options), 16)
    np.testing.assert_allclose(pixels[:, 8, 8].astype(int), expected, atol=2 if form == "JPEG" else 0)


def test_palette_with_transparent_colour(encoded):
    picture = flat((10, 200, 30), "RGB").convert("P", palette=Image.Palette.ADAPTIVE)
    index = picture.getpixel((0, 0))
    np.testing.assert_array_equal(
        read_image(encoded(picture, transparency=index), 16)[:, 0, 0], (255, 255, 255)
    )


@pytest.mark.parametrize("form", ["PNG", "TIFF", "PPM"])
def test_sixteen_bits_are_scaled_not_clipped(encoded, form):
    picture = Image.fromarray(RAMP.astype(np.uint16) * 257)
    if form == "PPM":
        picture = picture.convert("I")  # which every version of Pillow writes as 16 bits there
    np.testing.assert_array_equal(read_image(encoded(picture, form), 12), np.stack([RAMP] * 3))


def png(width: int, height: int, bits: int, colour_type: int, rows: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def test_sixteen_bit_colour(encoded):
    row = b"\0" + b"".join(struct.pack(">HHH", 0x2010, 0x8020, 0xFFFF) for _ in range(4))
    np.testing.assert_array_equal(read_image(png(4, 4, 16, 2, row * 4), 4)[:, 0, 0], (0x20, 0x80, 0xFF))


@pytest.mark.parametrize("value", [-1.0, 2.0, float("nan")])
def test_floats_outside_their_range_are_refused(encoded, value):
    with pytest.raises(Unreadable, match=r"outside 0\.\.1"):
        read_image(encoded(flat(value, "F"), "TIFF"), 16)


def test_integers_beyond_sixteen_bits_are_refused(encoded):
    with pytest.raises(Unreadable, match=r"outside 0\.\.65535"):
        read_image(encoded(flat(70_000, "I"), "TIFF"), 16)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_exif_orientation_is_applied(encoded, orientation, form):
    """An image stored turned, with the tag that says so, reads as the upright one."""
    upright = Image.new("RGB", (16, 16), "white")
    upright.paste("black", (0, 0, 8, 8))
    upright.paste("red", (8, 0, 16, 8))
    undo = {
        2: 0,
        3: 3,
        4: 1,
        5: 5,
        6: 2,
        7: 6,
        8: 4,
    }  # Pillow's transpositions that lead from upright to stored
    stored = upright if orientation == 1 else upright.transpose(Image.Transpose(undo[orientation]))
    exif = Image.Exif()
    exif[0x0112] = orientation
    options = (
        {"quality": 95, "subsampling": 0} if form == "JPEG" else {"lossless": True} if form == "WEBP" else {}
    )
    pixels = read_image(encoded(stored, form, exif=exif, **options), 16)
    corners = pixels[:, [2, 2, 13, 13], [2, 13, 2, 13]].T.astype(int)
    np.testing.assert_allclose(corners, [(0, 0, 0), (255, 0, 0), (255,) * 3, (255,) * 3], atol=12)


def test_damaged_exif_counts_as_none(encoded):
    plain = encoded(7, "JPEG")
    damaged = encoded(7, "JPEG", exif=b"Exif\0\0II*\0\xff\xff\xff\xff")
    np.testing.assert_array_equal(read_image(damaged, 12), read_image(plain, 12))


@pytest.mark.parametrize("form", ["GIF", "WEBP", "PNG", "TIFF"])
def test_first_frame_of_an_animation(encoded, form):
    first, second = flat((255, 0, 0), "RGB"), flat((0, 0, 255), "RGB")
    options = {"lossless": True} if form == "WEBP" else {}
    content = encoded(first, form, save_all=True, append_images=[second], **options)
    np.testing.assert_array_equal(read_image(content, 16)[:, 0, 0], (255, 0, 0))


def striped(width: int, height: int) -> Image.Image:
    """Three parts along the long side: red, green, blue."""
    picture = Image.new("RGB", (width, height), (255, 0, 0))
    long = max(width, height)
    box = (long // 3, 0, long, height) if width > height else (0, long // 3, width, long)
    picture.paste((0, 255, 0), box)
    box = (2 * long // 3, 0, long, height) if width > height else (0, 2 * long // 3, width, long)
    picture.paste((0, 0, 255), box)
    return picture


@pytest.mark.parametrize("size", [(36, 12), (12, 36), (90, 30)])
def test_crop_keeps_the_centre(encoded, size):
    pixels = read_image(encoded(striped(*size)), 12, fit="crop")
    assert (pixels == np.array([0, 255, 0])[:, None, None]).mean() > 0.99


@pytest.mark.parametrize("wide", [True, False])
def test_pad_and_stretch(encoded, wide):
    content = encoded(striped(36, 12) if wide else striped(12, 36))
    padded, stretched = (read_image(content, 12, fit=fit) for fit in ("pad", "stretch"))
    if not wide:
        padded, stretched = padded.transpose(0, 2, 1), stretched.transpose(0, 2, 1)
    assert (padded[:, :4] == 255).all() and (padded[:, 8:] == 255).all()
    for picture, row in ((padded, 6), (stretched, 2)):
        np.testing.assert_allclose(picture[:, row, [1, 6, 10]].T, 255 * np.eye(3), atol=3)


def test_unknown_fit_names_the_nearest(encoded):
    with pytest.raises(
        ValueError, match=r"unknown fit 'crops'; did you mean 'crop'\? \(known: crop, pad, stretch\)"
    ):
        read_image(encoded(0), 8, fit="crops")


def test_resizing_is_antialiased(encoded):
    """A fine checkerboard shrinks to grey; picking single pixels would give black or white."""
    board = ((np.indices((256, 256)).sum(0) % 2) * 255).astype(np.uint8)
    pixels = read_image(encoded(board), 16)
    assert np.abs(pixels.astype(int) - 128).max() <= 3


def test_reduced_jpeg_decoding_agrees_with_full(encoded, monkeypatch):
    ramp = np.linspace(0, 255, 1024).astype(np.uint8)
    array = np.stack(
        [ramp[None].repeat(768, 0), ramp[:768, None].repeat(1024, 1), np.full((768, 1024), 90, np.uint8)], 2
    )
    content = encoded(array, "JPEG", quality=95)
    for fit in FITS:
        reduced = read_image(content, 32, fit=fit).astype(int)
        with monkeypatch.context() as patch:
            patch.setattr(module, "_reduce_while_decoding", lambda *_: None)
            full = read_image(content, 32, fit=fit).astype(int)
        assert np.abs(reduced - full).max() <= 3


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (2, 3)])
@pytest.mark.parametrize("fit", FITS)
def test_tiny_and_narrow_pictures(encoded, size, fit):
    assert read_image(encoded(flat((9, 9, 9), "RGB", size)), 8, fit=fit).shape == (3, 8, 8)


def test_huge_pictures_are_refused_before_decoding():
    huge = png(30_000, 30_000, 8, 2, b"")
    with pytest.raises(Unreadable, match=r"30000 x 30000 is more than 170 million|exceeds limit"):
        read_image(huge, 16)
    with pytest.raises(Unreadable, match="13500 x 13000 is more than 170 million"):
        read_image(png(13_500, 13_000, 8, 2, b""), 16)


def test_large_pictures_within_the_limit_raise_no_warning(encoded, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 3_000)
    monkeypatch.setattr(module, "_LARGE_PIXELS", 1_000)
    assert read_image(encoded(flat((5, 6, 7), "RGB", (64, 64))), 16)[:, 0, 0].tolist() == [5, 6, 7]


def test_truncated_jpeg_has_a_reason(encoded):
    content = encoded(np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8), "JPEG")
    with pytest.raises(Unreadable, match=r"the given bytes cannot be used as an image: damaged .*truncated"):
        read_image(content[: len(content) // 2], 16)


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\xff\xd8\xff", b"<svg></svg>", b"%!PS-Adobe-3.0 EPSF-3.0\n"]
)
def test_what_is_no_picture_has_a_reason(content):
    with pytest.raises(Unreadable, match=r"not an image in a known format|damaged"):
        read_image(content, 16)


def test_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        read_image(tmp_path / "gone.png", 16)


def _samples() -> list[bytes]:
    samples = []
    picture = Image.fromarray(np.random.default_rng(1).integers(0, 256, (24, 20, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    for form, mode in [
        ("JPEG", "RGB"),
        ("PNG", "P"),
        ("GIF", "P"),
        ("TIFF", "RGB"),
        ("BMP", "RGB"),
        ("WEBP", "RGB"),
    ]:
        buffer = io.BytesIO()
        picture.convert(mode).save(
            buffer, form, **({"exif": exif} if form in ("JPEG", "PNG", "TIFF") else {})
        )
        samples.append(buffer.getvalue())
    return samples


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.sampled_from(_samples()), st.data())
def test_no_damage_raises_anything_but_unreadable(content, data):
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 6))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(1, len(damaged)))
    try:
        assert read_image(bytes(damaged[:cut]), 8).shape == (3, 8, 8)
    except Unreadable as problem:
        assert "cannot be used as an image" in str(problem)
