"""Broken, odd and hostile images through the commands: counted, named, and never a traceback.

What a command does with a folder and with files it is given is tried on one of each kind here; hostile.py
tries every command.
"""

import errno
import importlib
import json
import os
from pathlib import Path

import numpy as np
import pytest

import derender
from derender.cli import main
from derender.data import Unreadable, read_image, read_images
from derender.data.folder_source import FolderSource


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """The corpus, every format cut off at each sixteenth, and the module that made it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        module = importlib.import_module("hostility.files")
    return module, module.write_hostile(tmp_path_factory.mktemp("made") / "hostile")


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> str:
    net = derender.Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)
    return str(net.save(tmp_path_factory.mktemp("model") / "tiny"))


def test_every_odd_picture_is_read_and_every_broken_one_named(corpus):
    _, hostile = corpus
    pictures = read_images(hostile.folder, 16, dataset="folder")
    assert sorted(pictures.files) == sorted(hostile.readable)
    assert sorted(row.file for row in pictures.skipped) == sorted(hostile.unreadable)
    assert all(row.reason for row in pictures.skipped)
    assert f"{len(hostile.unreadable)} skipped" in pictures.describe()


def test_a_picture_alone_is_read_as_in_a_folder(corpus):
    _, hostile = corpus
    for name in hostile.readable:
        if "\\" not in name:
            assert read_image(hostile.folder / name, 16).shape == (3, 16, 16)
    for name in hostile.unreadable:
        with pytest.raises((Unreadable, OSError)):
            read_image(hostile.folder / name, 16)


def test_exif_turns_a_picture_and_an_animation_gives_its_first_frame(corpus):
    module, hostile = corpus
    turned = read_image(hostile.folder / "rotated.jpg", 16, fit="stretch").astype(int)
    plain = read_image(module.encoded(module.smooth(seed=20), "JPEG"), 16, fit="stretch").astype(int)
    assert np.abs(turned - np.rot90(plain, -1, (1, 2))).mean() < 3 < np.abs(turned - plain).mean()
    first = read_image(module.encoded(module.smooth(seed=16), "PNG"), 16)
    assert np.array_equal(read_image(hostile.folder / "animated.png", 16), first)


def test_the_doctor_names_every_broken_file(corpus, tmp_path, capsys):
    _, hostile = corpus
    code = main(
        ["doctor", str(hostile.folder), "--dataset", "folder", "--json", str(tmp_path / "found.json")]
    )
    told = json.loads((tmp_path / "found.json").read_text())
    assert sorted(row["file"] for row in told["unreadable"]) == sorted(hostile.unreadable)
    assert code == 0 and "Traceback" not in capsys.readouterr().err


def test_embedding_counts_them_and_names_the_first(corpus, model, tmp_path, capsys):
    _, hostile = corpus
    told = tmp_path / "told.json"
    given = [
        "embed",
        "--data",
        str(hostile.folder),
        "--model",
        model,
        "--dataset",
        "folder",
        "--device",
        "cpu",
    ]
    given += ["--device", "cpu", "--out", str(tmp_path / "F.parquet"), "--json", str(told)]
    assert main(given) == 0
    assert json.loads(told.read_text())["skipped"] == len(hostile.unreadable)
    said = capsys.readouterr().err
    assert f"{len(hostile.unreadable)} skipped" in said and said.count("\nskipped ") == 5


def test_files_by_name_are_done_and_the_broken_ones_named(corpus, model, tmp_path, capsys):
    module, hostile = corpus
    broken = tuple(name for name in hostile.unreadable if "bomb" not in name and "cut" not in name)
    files = [str(hostile.folder / name) for name in ("plain.jpg", "one pixel.png", "two\nlines.png", *broken)]
    given = ["decompose", *files, "--model", model, "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(given) == 2
    assert module.named_in(capsys.readouterr().err, broken) == []
    assert len(list((tmp_path / "out").iterdir())) == 3


def test_a_zip_gives_its_pictures_and_writes_nothing(corpus, tmp_path):
    module, _ = corpus
    archive = module.write_hostile_zip(tmp_path / "deep" / "er" / "hostile.zip")
    pictures = read_images(archive, 16)
    assert pictures.files == tuple(f"good/{number}.png" for number in range(4))
    reasons = {row.file: row.reason for row in pictures.skipped}
    assert sum("unsafe name" in reason for reason in reasons.values()) == 5
    assert reasons["encrypted.png"] == "encrypted in the zip"
    assert "not an image" in reasons["link.png"]
    assert reasons["huge.png"] == "unpacks to 4,095 MiB, more than 512 MiB"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["hostile.zip"]


def test_a_file_that_goes_between_listing_and_reading_is_skipped(corpus, tmp_path, monkeypatch):
    module, _ = corpus
    for number in range(3):
        (tmp_path / f"{number}.png").write_bytes(module.encoded(module.smooth(seed=number), "PNG"))
    read = FolderSource.read

    def gone(source: FolderSource, file: str) -> bytes:
        (tmp_path / "1.png").unlink(missing_ok=True)
        return read(source, file)

    monkeypatch.setattr(FolderSource, "read", gone)
    pictures = read_images(tmp_path, 16)
    assert pictures.files == ("0.png", "2.png")
    assert [row.file for row in pictures.skipped] == ["1.png"]


def test_files_and_folders_without_permission_are_skipped_and_named(corpus, tmp_path, monkeypatch):
    """Refused by hand, since whoever runs the tests may be allowed to read everything."""
    module, _ = corpus
    (tmp_path / "closed").mkdir()
    for number, name in enumerate(("0.png", "1.png", "closed/2.png", "3.png")):
        (tmp_path / name).write_bytes(module.encoded(module.smooth(seed=number), "PNG"))

    def refusing(function):
        def refused(path, *rest):
            if Path(path).name in ("1.png", "closed"):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return function(path, *rest)

        return refused

    monkeypatch.setattr(Path, "open", refusing(Path.open))
    monkeypatch.setattr(os, "scandir", refusing(os.scandir))
    pictures = read_images(tmp_path, 16)
    assert pictures.files == ("0.png", "3.png")
    assert {row.file: row.reason for row in pictures.skipped} == {
        "1.png": f"cannot be read: {os.strerror(errno.EACCES)}",
        "closed": f"folder cannot be listed: {os.strerror(errno.EACCES)}",
    }


def test_names_cannot_steer_the_terminal(corpus, model, tmp_path, capsys):
    module, _ = corpus
    evil = "\x1b]0;owned\x07\x1b[2J.png"
    for name in ("0.png", "1.png"):
        (tmp_path / name).write_bytes(module.encoded(module.smooth(seed=int(name[0])), "PNG"))
    (tmp_path / evil).write_bytes(b"broken")
    given = ["embed", "--model", model, "--data", str(tmp_path), "--device", "cpu"]
    assert main([*given, "--out", str(tmp_path / "F.parquet")]) == 0
    assert main(["decompose", str(tmp_path / evil), "--model", model, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert "\x1b" not in said.err + said.out and "\x07" not in said.err + said.out
    assert "\\x1b]0;owned" in said.err


def test_devices_and_pipes_are_refused_at_once(corpus):
    _, hostile = corpus
    for path in (hostile.folder / "pipe.png", Path("/dev/zero")):
        with pytest.raises(Unreadable, match="not a regular file"):
            read_image(path, 16)
