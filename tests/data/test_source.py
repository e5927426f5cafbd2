"""Folders, zips and single files: which files are seen, and what hostile ones lead to."""

import contextlib
import io
import os
import tempfile
import zipfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derender.data import open_source, zip_source


@pytest.mark.parametrize("zipped", [False, True])
def test_files_are_sorted_and_hidden_ones_left_out(tree, zipped):
    names = [
        "b/2.png",
        "a/10.png",
        "a/9.png",
        ".hidden.png",
        "__MACOSX/a/._9.png",
        ".git/x.png",
        "B/1.png",
        "n.txt",
    ]
    with open_source(tree(names, zipped)) as source:
        assert source.files == ("B/1.png", "a/10.png", "a/9.png", "b/2.png", "n.txt")
        assert source.skipped == ()


def test_same_bytes_from_folder_and_zip(tree):
    names = ["a/ä b.png", "new\nline.png", "c.txt"]
    with open_source(tree(names)) as folder, open_source(tree(names, zipped=True)) as archive:
        assert folder.files == archive.files
        assert [folder.read(file) for file in folder.files] == [archive.read(file) for file in archive.files]


def test_link_loops_end_and_linked_folders_are_read_once(tree):
    folder = tree(["a/1.png", "b/2.png"])
    (folder / "a" / "up").symlink_to(folder, target_is_directory=True)
    (folder / "z").symlink_to(folder / "b", target_is_directory=True)
    with open_source(folder) as source:
        assert source.files == ("a/1.png", "b/2.png")


def test_hard_links_are_files_of_their_own(tree):
    folder = tree(["a/1.png"])
    os.link(folder / "a" / "1.png", folder / "a" / "2.png")
    with open_source(folder) as source:
        assert source.files == ("a/1.png", "a/2.png")
        assert source.read("a/1.png") == source.read("a/2.png")


def test_linked_folder_outside_is_read(tree):
    outside = tree(["1.png"], name="outside")
    folder = tree(["2.png"])
    (folder / "linked").symlink_to(outside, target_is_directory=True)
    with open_source(folder) as source:
        assert source.files == ("2.png", "linked/1.png")


def test_broken_links_and_pipes_are_listed_not_read(tree):
    folder = tree(["1.png"])
    (folder / "gone.png").symlink_to(folder / "nowhere.png")
    os.mkfifo(folder / "pipe.png")
    with open_source(folder) as source:
        assert source.files == ("1.png",)
        assert [row.file for row in source.skipped] == ["gone.png", "pipe.png"]
        assert "broken link" in source.skipped[0].reason


def test_names_that_are_not_utf8_can_be_stored(tree):
    folder = tree(["1.png"])
    (Path(os.fsdecode(os.fsencode(folder) + b"/\xff.png"))).write_bytes(b"content")
    with open_source(folder) as source:
        assert source.files == ("1.png", "\\xff.png")
        assert source.read("\\xff.png") == b"content"
        "".join(source.files).encode("utf-8")


def test_unsafe_names_in_a_zip_are_passed_over(tree):
    names = ["../up.png", "/absolute.png", "a/../../b.png", "C:\\drive.png", "a\\windows.png", "good.png"]
    path = tree(names, zipped=True)
    before = set(path.parent.rglob("*"))
    with open_source(path) as source:
        assert source.files == ("a/windows.png", "good.png")
        assert len(source.skipped) == 4
        assert all("unsafe name" in row.reason for row in source.skipped)
        source.read("a/windows.png")
    assert set(path.parent.rglob("*")) == before


def test_zip_bomb_is_bounded(tmp_path, monkeypatch):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.png", bytes(2_000_000))
    monkeypatch.setattr(zip_source, "FILE_LIMIT_BYTES", 1 << 20)
    with open_source(path) as source, pytest.raises(ValueError, match="unpacks to 1 MiB, more than 1 MiB"):
        source.read("bomb.png")


def test_encrypted_member_is_listed(tree):
    path = tree(["secret.png", "open.png"], zipped=True)
    raw = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        raw[raw.index(mark) + offset] |= 1
    path.write_bytes(bytes(raw))
    with open_source(path) as source:
        assert source.files == ("open.png",)
        assert [(row.file, row.reason) for row in source.skipped] == [("secret.png", "encrypted in the zip")]


def test_damaged_member_says_so(tree):
    path = tree({"a.bin": b"x" * 100}, zipped=True)
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"x" * 100, b"x" * 99 + b"y"))
    with open_source(path) as source, pytest.raises(ValueError, match="cannot be unpacked: Bad size or CRC"):
        source.read("a.bin")


@pytest.mark.parametrize("content", [b"", b"no zip at all", b"PK\x03\x04 cut short"])
def test_a_zip_that_is_none_is_named(tmp_path, content):
    (tmp_path / "faces.zip").write_bytes(content)
    with pytest.raises(ValueError, match=r"faces\.zip is damaged or not a whole zip file .*again"):
        open_source(tmp_path / "faces.zip")


def _deflated_zip() -> bytes:
    buffer = io.BytesIO()
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        with zipfile.ZipFile(buffer, "a", method) as archive:
            archive.writestr(f"{method}.png", b"some text, some text" * 5)
    return buffer.getvalue()


DEFLATED_ZIP = _deflated_zip()


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.data())
def test_no_damage_to_a_zip_raises_anything_but_value_errors(data):
    damaged = bytearray(DEFLATED_ZIP)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.zip"
        path.write_bytes(bytes(damaged))
        try:
            with open_source(path) as source:
                for file in source.files:
                    with contextlib.suppress(ValueError):
                        source.read(file)
        except ValueError as problem:
            assert "damaged or not a whole zip" in str(problem)


def test_cut_zip_is_named(tree):
    path = tree(["1.png", "2.png"], zipped=True)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(ValueError, match="damaged or not a whole zip"):
        open_source(path)


def test_missing_source_names_the_nearest(tree):
    folder = tree(["1.png"], name="UTKFace")
    with pytest.raises(ValueError, match=r"utkfaces does not exist; did you mean 'UTKFace'\?"):
        open_source(folder.parent / "utkfaces")
    (folder / "11.py").touch()
    with pytest.raises(ValueError, match=r"11\.pn does not exist; did you mean '1\.png'\?"):
        open_source(folder / "11.pn")
    with pytest.raises(ValueError, match="does not exist; nor does its folder"):
        open_source(folder.parent / "no" / "where")


def test_other_files_are_refused(tmp_path):
    (tmp_path / "faces.tar").write_bytes(b"x" * 2000)
    with pytest.raises(ValueError, match=r"faces\.tar is no folder, zip or image .* unpack"):
        open_source(tmp_path / "faces.tar")


def test_a_zip_by_another_name_and_a_pipe(tree, tmp_path):
    path = tree(["1.png"], zipped=True).rename(tmp_path / "comic.cbz")
    with open_source(path) as source:
        assert source.files == ("1.png",)
    path.write_bytes(path.read_bytes()[:-1])
    os.mkfifo(tmp_path / "pipe.zip")
    for other in (path, tmp_path / "pipe.zip"):
        with pytest.raises(ValueError, match="is no folder, zip or image"):
            open_source(other)


def test_text_must_be_utf8(tree):
    with open_source(tree({"a.csv": b"\xef\xbb\xbffile\n", "b.csv": b"\xe4\n"})) as source:
        assert source.read_text("a.csv") == "file\n"
        with pytest.raises(ValueError, match=r"b\.csv in .* is not UTF-8"):
            source.read_text("b.csv")
