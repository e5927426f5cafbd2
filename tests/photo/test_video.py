"""A video in, a video out: every frame, the same sound, parameters that do not flicker."""

import subprocess

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from tests.photo.test_align import head, scene

import derender
from derender.cli import main
from derender.photo import edit_video
from derender.photo.video import _frames, write_video


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Six frames of a head that moves to the right and flickers, with a tone."""
    folder = tmp_path_factory.mktemp("film")
    still, face = scene().resize((120, 90)), head(0, 60)
    frames = []
    for number in range(6):
        frame = still.copy()
        frame.paste(face, (10 + 6 * number, 15))
        frames.append((np.asarray(frame) * (1.0 if number % 2 else 0.8)).astype(np.uint8))
    tone = folder / "tone.wav"
    words = ["-f", "lavfi", "-i", "sine=frequency=440:duration=0.8", str(tone)]
    subprocess.run([get_ffmpeg_exe(), "-loglevel", "error", *words], check=True)
    write_video(folder / "film.mp4", iter(frames), (120, 90), 10.0, tone)
    return folder / "film.mp4"


def read(path):
    return np.stack(list(_frames(path)))


def has_sound(path):
    words = ["-nostdin", "-loglevel", "error", "-i", str(path), "-map", "0:a:0", "-f", "null", "-"]
    return subprocess.run([get_ffmpeg_exe(), *words], capture_output=True).returncode == 0


def test_the_unchanged_scene_gives_the_film_back_with_its_sound(film, tmp_path):
    model = derender.load("rendered-faces-64")
    jumps = []

    def unchanged(scenes):
        jumps.append(scenes.light.diff(dim=0).abs().max().item())
        return {"light": scenes.light}

    done = edit_video(film, tmp_path / "same.mp4", model, unchanged, fit_steps=0)
    assert (done.frames, done.width, done.height, done.searched, done.found) == (6, 120, 90, 3, 3)
    before, after = read(film), read(tmp_path / "same.mp4")
    assert has_sound(film) and has_sound(tmp_path / "same.mp4")
    assert after.shape == before.shape == (6, 90, 120, 3)
    assert np.abs(after.astype(int) - before).mean() < 2
    cuts = np.stack([one[15:75, 10 + 6 * k : 70 + 6 * k] for k, one in enumerate(before)])
    raw = model.decompose(cuts).light.diff(dim=0).abs().max().item()
    assert jumps[0] < 0.5 * raw


def test_a_film_is_relit_where_its_face_is(film, tmp_path, capfd, monkeypatch, tiny):
    monkeypatch.setattr("derender.cli.console.PLAIN_LINE_EVERY_SECONDS", 3600)
    words = ["relight", "-m", "rendered-faces-64", str(film), "-o", str(tmp_path / "out"), "--hold"]
    assert main(words) == 0
    change = np.abs(read(tmp_path / "out" / "film" / "film.mp4").astype(int) - read(film))
    first, last = change[0].mean(axis=(0, 2)), change[-1].mean(axis=(0, 2))
    assert first[20:60].mean() > 4 * first[100:].mean() and last[55:95].mean() > 4 * last[:15].mean()
    (tmp_path / "none.mp4").write_bytes(b"no film")
    (tmp_path / "none.png").write_bytes(b"no image")
    write_video(tmp_path / "short.mp4", iter(read(film)[:2]), (120, 90), 10.0)
    named = [str(tmp_path / name) for name in ("short.mp4", "none.mp4", "none.png")]
    words = ["relight", "-m", str(tiny), *named, "-o", str(tmp_path / "two"), "--fit-steps", "0"]
    assert main(words) == 2  # the others are edited
    assert capfd.readouterr().err.count("\n") == 2, "a line each, and none of OpenCV's"
    assert [folder.name for folder in (tmp_path / "two").iterdir()] == ["short"]
    assert main(["mesh", "-m", str(tiny), str(film), "-o", str(tmp_path / "mesh")]) == 2
    assert "is a video" in capfd.readouterr().err
    for option in ("--only-frame", "--size=64", "--detail=model"):
        assert main([*words[:3], str(film), "-o", str(tmp_path / "whole"), option]) == 2
        assert "is a video, which is drawn whole" in capfd.readouterr().err
    with pytest.raises(ValueError, match="cannot be read as a video"):
        edit_video(tmp_path / "none.mp4", tmp_path / "x.mp4", derender.load(tiny), dict)
    with pytest.raises(ValueError, match="unknown frame of a video 'auto': choose face or none"):
        edit_video(tmp_path / "none.mp4", tmp_path / "x.mp4", derender.load(tiny), dict, frame="auto")
