"""Strips, films and sheets as a player and a person find them."""

import io
import json
import subprocess

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image

from derender.report.edits import Edit
from derender.report.options import FilmOptions
from derender.report.panel import row_sheets
from derender.report.sweeps import animated_png, gif, mp4


def frames(count: int = 6, size: tuple[int, int] = (33, 24)) -> list[Image.Image]:
    """Frames that get darker, with a transparent left column."""
    made = []
    for number in range(count):
        pixels = np.full((size[1], size[0], 4), 255, np.uint8)
        pixels[..., :3] = 220 - 30 * number
        pixels[:, :8, 3] = 0
        made.append(Image.fromarray(pixels))
    return made


def test_gif_has_every_frame_on_white():
    with Image.open(io.BytesIO(gif(frames(), seconds=1.2))) as film:
        assert film.n_frames == 6 and film.size == (33, 24) and film.info["loop"] == 0
        assert film.info["duration"] == 200
        film.seek(3)
        shown = np.asarray(film.convert("RGB"))
    assert (shown[:, :8] == 255).all()
    assert abs(int(shown[5, 20, 0]) - 130) <= 2


def test_animated_png_keeps_transparency():
    with Image.open(io.BytesIO(animated_png(frames()))) as film:
        assert film.n_frames == 6 and film.size == (33, 24) and film.info["loop"] == 0
        assert film.convert("RGBA").getpixel((3, 3))[3] == 0


def test_mp4_has_every_frame_and_even_sides(tmp_path):
    (tmp_path / "film.mp4").write_bytes(mp4(frames(), seconds=1.2))
    words = ["-v", "error", "-i", "film.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run([get_ffmpeg_exe(), *words], cwd=tmp_path, capture_output=True, check=True).stdout
    shown = np.frombuffer(raw, np.uint8).reshape(6, 24, 34, 3)
    assert shown[3, 12, 20].astype(int).tolist() == pytest.approx([130] * 3, abs=6)
    assert shown[3, 12, 3].min() > 245


def test_no_ffmpeg_is_an_error_that_helps(monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "no-such-program")
    with pytest.raises(ValueError, match=r"ffmpeg cannot write MP4 here: .*: write a GIF instead"):
        mp4(frames())


def test_a_folder_has_strip_stills_film_and_numbers(tmp_path):
    images = frames(3, (20, 20))
    stills = dict(zip("ab", images[1:], strict=True))
    edit = Edit({"input": images[0]}, stills, {"a": {"x": 1}, "b": {"x": 2}}, images, FilmOptions(film="gif"))
    written = edit.write(tmp_path, {"picture": "one.png"})
    names = {"strip.png", "still-01.png", "still-02.png", "film.gif", "moved.json"}
    assert {file.name for file in tmp_path.iterdir()} == names
    assert json.loads((tmp_path / "moved.json").read_text()) == written
    assert [still["x"] for still in written["stills"]] == [1, 2] and written["picture"] == "one.png"
    with Image.open(tmp_path / "still-02.png") as still:
        assert still.mode == "RGBA" and still.tobytes() == images[2].tobytes()
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.width > 3 * 128


def test_sheets_break_after_so_many_rows():
    rows = [(f"{number}.png", {"input": frames(1)[0], "after": frames(1)[0]}) for number in range(5)]
    first, second, third = row_sheets(rows, most=2)
    assert first.height == second.height > third.height
    assert row_sheets([]) == []
