"""Broken, odd and hostile images through the commands: counted, named, and never a traceback.

What a command does with a folder and with files it is given is tried on one of each kind here; hostile.py
tries every command.
"""

import errno
import json
import os
import resource
import struct
from pathlib import Path

import numpy as np
import pytest
from tests.trust.hostile_files import UNSAFE, encoded, smooth, write_hostile, write_hostile_zip

from derender.cli import main
from derender.data import Unreadable, read_image, read_images
from derender.data.source import FolderSource


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """The corpus, every format cut off at each eighth."""
    return write_hostile(tmp_path_factory.mktemp("made") / "hostile", steps=8)


@pytest.fixture
def plain(tmp_path) -> Path:
    """A folder of three images."""
    for number in range(3):
        (tmp_path / f"{number}.png").write_bytes(encoded(smooth(number)))
    return tmp_path


def test_every_odd_image_is_read_and_every_broken_one_named(hostile):
    images = read_images(hostile.folder, 16, dataset="folder")
    assert sorted(images.files) == sorted(hostile.readable)
    assert sorted(row.file for row in images.skipped) == sorted(hostile.unreadable)
    assert all(row.reason for row in images.skipped)
    assert f"{len(hostile.unreadable)} skipped" in images.describe()


def test_an_image_alone_is_read_as_in_a_folder(hostile):
    for name in hostile.readable:
        if "\\" not in name:
            assert read_image(hostile.folder / name, 16).shape == (3, 16, 16)
    for name in hostile.unreadable:
        with pytest.raises((Unreadable, OSError)):
            read_image(hostile.folder / name, 16)
    for path in (hostile.folder / "pipe.png", Path("/dev/zero")):
        with pytest.raises(Unreadable, match="not a regular file"):
            read_image(path, 16)


def test_exif_turns_an_image_and_an_animation_gives_its_first_frame(hostile):
    turned = read_image(hostile.folder / "rotated.jpg", 16, fit="stretch").astype(int)
    straight = read_image(encoded(smooth(20), "JPEG"), 16, fit="stretch").astype(int)
    assert np.abs(turned - np.rot90(straight, -1, (1, 2))).mean() < 3 < np.abs(turned - straight).mean()
    first = read_image(hostile.folder / "animated.png", 16)
    assert np.array_equal(first, read_image(encoded(smooth(16)), 16))


def test_commands_count_broken_files_and_name_them(hostile, tiny, tmp_path, capsys):
    told = tmp_path / "told.json"
    every = [str(hostile.folder), "--dataset", "folder", "--json", str(told)]
    assert main(["doctor", *every]) == 0
    unreadable = json.loads(told.read_text())["unreadable"]
    assert sorted(row["file"] for row in unreadable) == sorted(hostile.unreadable)
    out = ["--model", str(tiny), "--device", "cpu", "--out"]
    assert "Traceback" not in capsys.readouterr().err
    assert main(["embed", *every, *out, str(tmp_path / "F.parquet")]) == 0
    assert json.loads(told.read_text())["skipped"] == len(hostile.unreadable)
    message = capsys.readouterr().err
    assert f"{len(hostile.unreadable)} skipped" in message and message.count("\nskipped ") == 5
    broken = tuple(name for name in hostile.unreadable if "bomb" not in name and "cut" not in name)
    files = [str(hostile.folder / name) for name in ("plain.jpg", "one pixel.png", "two\nlines.png", *broken)]
    assert main(["decompose", *files, "--json", str(told), *out, str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("left out ") == 5 and f"and {len(broken) - 5} more (--json names all)" in message
    assert json.loads(told.read_text())["refused"].keys() == {str(hostile.folder / name) for name in broken}
    assert len(list((tmp_path / "out").iterdir())) == 3


def test_a_zip_gives_its_images_and_writes_nothing(tmp_path):
    images = read_images(write_hostile_zip(tmp_path / "deep" / "er" / "hostile.zip"), 16)
    assert images.files == tuple(f"good/{number}.png" for number in range(4))
    reasons = {row.file: row.reason for row in images.skipped}
    assert sum("unsafe name" in reason for reason in reasons.values()) == len(UNSAFE)
    assert reasons["encrypted.png"] == "encrypted in the zip"
    assert "not an image" in reasons["link.png"]
    assert reasons["huge.png"] == "unpacks to 4,095 MiB, more than 512 MiB"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["hostile.zip"]


def test_a_file_that_goes_between_listing_and_reading_is_skipped(plain, monkeypatch):
    read = FolderSource.read

    def gone(source: FolderSource, file: str) -> bytes:
        (plain / "1.png").unlink(missing_ok=True)
        return read(source, file)

    monkeypatch.setattr(FolderSource, "read", gone)
    images = read_images(plain, 16)
    assert images.files == ("0.png", "2.png") and [row.file for row in images.skipped] == ["1.png"]


def test_files_and_folders_without_permission_are_skipped_and_named(plain, monkeypatch):
    """Refused by hand, since whoever runs the tests may be allowed to read everything."""
    (plain / "closed").mkdir()
    (plain / "closed" / "3.png").write_bytes(encoded(smooth(3)))

    def refusing(function):
        def refused(path, *rest):
            if Path(path).name in ("1.png", "closed"):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return function(path, *rest)

        return refused

    monkeypatch.setattr(Path, "open", refusing(Path.open))
    monkeypatch.setattr(os, "scandir", refusing(os.scandir))
    images = read_images(plain, 16)
    assert images.files == ("0.png", "2.png")
    assert {row.file: row.reason for row in images.skipped} == {
        "1.png": f"cannot be read: {os.strerror(errno.EACCES)}",
        "closed": f"folder cannot be listed: {os.strerror(errno.EACCES)}",
    }


def test_names_cannot_steer_the_terminal(plain, tiny, capsys):
    evil = plain / "\x1b]0;owned\x07\x1b[2J.png"
    evil.write_bytes(b"broken")
    given = ["--model", str(tiny), "--device", "cpu", "--out"]
    assert main(["embed", "--data", str(plain), *given, str(plain / "F.parquet")]) == 0
    assert main(["decompose", str(evil), *given, str(plain / "out")]) == 2
    message = capsys.readouterr()
    assert "\x1b" not in message.err + message.out and "\x07" not in message.err + message.out
    assert "\\x1b]0;owned" in message.err


def test_a_damaged_heic_or_one_that_claims_gigapixels_is_one_line_and_takes_no_memory():
    heif = pytest.importorskip("pillow_heif", reason="HEIC photographs need pip install pillow-heif")
    heif.register_heif_opener()
    whole = encoded(smooth(0, (256, 192)), "HEIF", quality=80)
    assert read_image(whole, 16).shape == (3, 16, 16)
    size = whole.index(b"ispe") + 8  # of the box: version, flags, width, height
    claims = {n: whole[:size] + struct.pack(">II", n, n) + whole[size + 8 :] for n in (13_000, 60_000)}
    cut = [whole[: len(whole) * part // 8] for part in range(1, 8)]
    other = [whole[:32] + encoded(smooth(1), "JPEG"), whole[:32], whole[:size]]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for broken in (*claims.values(), *cut, *other):
        with pytest.raises(Unreadable) as told:
            read_image(broken, 16)
        assert "pip install" not in str(told.value) and "\n" not in str(told.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB
    assert read_image(encoded(smooth(1), "JPEG"), 16).shape == (3, 16, 16)  # whatever its name
