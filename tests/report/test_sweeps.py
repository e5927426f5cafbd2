"""Sweeps of light and view, swaps; strips, films and sheets as a player and a person find them."""

import io
import json
import subprocess
from functools import partial
from math import radians

import numpy as np
import pytest
import torch
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image

from derender.render import render_scene
from derender.report import sweeps
from derender.report.colours import on_background
from derender.report.edits import Edit
from derender.report.options import FilmOptions
from derender.report.panel import row_sheets
from derender.report.sweeps import animated_png, gif, mp4
from derender.scene import Scene

FOV_DEG = 10.0
render = partial(render_scene, fov_deg=FOV_DEG)


def ball(size: int = 24) -> Scene:
    axis = torch.linspace(-1, 1, size)
    depth = 1.04 - 0.06 * torch.exp(-4 * (axis[:, None] ** 2 + axis[None] ** 2))
    light = torch.tensor([[0.2, 0.7, 0.1, 0.3]])
    return Scene(depth[None], torch.full((1, 3, size, size), 0.6), light, torch.zeros(1, 6))


def test_places():
    film = sweeps.there_and_back(8)
    torch.testing.assert_close(film[[0, 2, 4, 6]], torch.tensor([0.0, 0.5, 1.0, 0.5]))
    assert float(film[0] - film[-1]) == pytest.approx(float(film[0] - film[1]))  # the loop closes


def test_light_goes_from_the_right_of_the_picture_to_its_left():
    lights = sweeps.lights_around(torch.linspace(0, 1, 3), 50, 10)
    torch.testing.assert_close(lights[:, 3], torch.tensor([radians(-50), 0, radians(50)]))
    torch.testing.assert_close(lights[:, 2], torch.full((3,), radians(10)))
    images = render(sweeps.varied(ball(), light=lights)).image
    left, right = images[..., :11].mean(dim=(1, 2, 3)), images[..., -11:].mean(dim=(1, 2, 3))
    assert left[0] < right[0] and left[2] > right[2]
    assert float(left[1]) == pytest.approx(float(right[1]), abs=1e-3)


def test_turning_looks_right_first_then_left():
    cameras = sweeps.cameras_around(torch.linspace(0, 1, 3), 30)
    torch.testing.assert_close(cameras[1], torch.zeros(6))
    spotted = ball()
    spotted = spotted.with_parameters(albedo=torch.zeros_like(spotted.albedo))
    spotted.albedo[:, 0, 10:14, 10:14] = 1  # on the tip of the nose
    images = render(sweeps.varied(spotted, camera=cameras)).image
    red = images[:, 0].sum(dim=1)
    first, middle, last = ((red * torch.arange(24.0)).sum(dim=1) / red.sum(dim=1)).tolist()
    assert first > middle + 0.5 and middle - 0.5 > last
    torch.testing.assert_close(images[1:2], render(spotted).image)


def test_only_the_swept_parameter_changes():
    scene = ball()
    changed = sweeps.varied(scene, camera=sweeps.cameras_around(torch.linspace(0, 1, 4), 20, 5))
    assert len(changed) == 4
    for name in ("depth", "albedo", "light"):
        values = changed.parameters[name]
        torch.testing.assert_close(values, scene.parameters[name].expand_as(values))


def test_swapping_takes_one_parameter():
    scene, donor = ball(), ball()
    donor = donor.with_parameters(light=donor.light + 0.1, albedo=donor.albedo * 0.5)
    mixed = sweeps.swapped(scene, donor, "light")
    torch.testing.assert_close(mixed.light, donor.light)
    torch.testing.assert_close(mixed.albedo, scene.albedo)
    with pytest.raises(ValueError, match="unknown parameter 'geometry'; there is depth, albedo"):
        sweeps.swapped(scene, donor, "geometry")


def test_loops_move_and_close():
    for loop in (sweeps.circling_light, sweeps.nodding_view):
        scene = loop(ball(), 8)
        frames = sweeps.drawn(scene, render)
        assert len(frames) == 8 and len({frame.tobytes() for frame in frames}) > 4
        first, last = (np.asarray(on_background(frame)).astype(int) for frame in (frames[0], frames[-1]))
        assert np.abs(first - last).mean() < 40
    assert [frame.size for frame in sweeps.relit_and_rotated(ball(), render, 2)] == [(48, 24)] * 2


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sweeps.lights_around(torch.zeros(2), 90), "reach must lie between -90 and 90"),
        (lambda: sweeps.lights_around(torch.zeros(2), 9, strength=-1), "strength of a light must be 0"),
        (lambda: sweeps.cameras_around(torch.zeros(2), 10, 95), "pitch must lie between"),
    ],
)
def test_bad_sweeps(call, message):
    with pytest.raises(ValueError, match=message):
        call()


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
