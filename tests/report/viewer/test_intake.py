"""What is no image, lies, or would fill the memory is refused with a sentence; what is one is read."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import encode
from tests.trust.hostile_files import png_that_says

from derender.report.viewer.app import BODY_LIMIT_BYTES
from derender.report.viewer.questions import PIXEL_LIMIT, Refused, pixels_of


def saved(form: str, mode: str = "RGB", size: tuple[int, int] = (20, 14)) -> bytes:
    return encode(Image.effect_noise(size, 80).convert(mode), form)


@pytest.mark.parametrize("form", ["PNG", "JPEG", "WEBP", "BMP", "GIF", "TIFF", "PPM"])
def test_pictures_are_read_whatever_they_are_called(client, form):
    reply = client.post("/api/pictures", saved(form), {"Content-Type": "text/html"})
    assert reply.status == 200
    assert pixels_of(saved(form), 8).shape == (3, 8, 8)


@pytest.mark.parametrize(
    ("content", "status", "words"),
    [
        (b"", 415, "empty"),
        (b"<html><script>alert(1)</script></html>", 415, "not an image"),
        (b'<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>', 415, "not an image"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", 415, "not an image"),
        (b"PK\x03\x04" + bytes(99), 415, "not an image"),
        (saved("PNG")[:60], 415, "damaged"),
        (png_that_says(60_000, 60_000), 413, "million pixels"),
        (png_that_says(8160, 6144), 413, "make it smaller"),  # 50 million pixels
    ],
    ids=["empty", "html", "svg", "postscript", "zip", "cut off", "bomb", "50 megapixels"],
)
def test_what_is_refused(client, content, status, words):
    reply = client.post("/api/pictures", content, {"Content-Type": "image/jpeg"})
    assert reply.status == status
    assert words in reply.error
    assert "/" not in reply.error and "0x" not in reply.error


def test_bounds_on_pixels_and_bytes(client):
    with pytest.raises(Refused, match="40 million"):
        pixels_of(png_that_says(PIXEL_LIMIT // 1000 + 1, 1000), 8)
    reply = client.post("/api/pictures", bytes(BODY_LIMIT_BYTES + 1))
    assert (reply.status, "20 MB" in reply.error) == (413, True)


def test_transparent_and_turned_pictures_are_laid_right():
    assert (pixels_of(encode(Image.new("RGBA", (9, 9), (0, 0, 0, 0))), 4) == 255).all()
    half = Image.fromarray(np.repeat(np.array([[0], [255]], np.uint8), 8, axis=0).repeat(16, axis=1))
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    upright = pixels_of(encode(half.convert("RGB"), "JPEG", exif=exif, quality=95), 16)
    assert upright[:, :4].mean() > 200 > 50 > upright[:, -4:].mean()


def test_nothing_is_kept_on_disk(client, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    client.opened(5)
    assert not list(Path(tmp_path).iterdir())
