"""Large sets in a memory map: the same images as in memory, kept, checked, made again after any change."""

import errno
import os
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from derender.data import cache as module
from derender.data import cache_folder, read_images
from derender.data import image_set as image_set_module


@pytest.fixture
def decoded(monkeypatch) -> list[int]:
    """How many images each real decoding read."""
    counts, real = [], image_set_module.decoded

    def counting(*of, **options):
        counts.append(0)
        for chunk in real(*of, **options):
            counts[-1] += len(chunk)
            yield chunk

    monkeypatch.setattr(image_set_module, "decoded", counting)
    return counts


@pytest.fixture
def folder(tree, encoded) -> Path:
    files = {f"cat/{row:02d}.png": None for row in range(40)}
    return tree({**files, "dog/bad.png": "text", "dog/copy.png": encoded(3), "dog/one.png": None})


def same(one, other) -> bool:
    skip = ("images", "labels")
    fields = [{k: v for k, v in vars(s).items() if k not in skip} for s in (one, other)]
    labels = all((one.labels[name] == other.labels[name]).all() for name in one.labels)
    return fields[0] == fields[1] and labels and bool((one.images == other.images).all())


def test_memory_and_map_agree_and_the_map_is_kept(folder, tmp_path, decoded):
    in_memory = read_images(folder, 8)
    mapped = read_images(folder, 8, cache=tmp_path / "cache")
    again = read_images(folder, 8, cache=tmp_path / "cache")
    assert isinstance(mapped.images, np.memmap)
    assert not isinstance(in_memory.images, np.memmap)
    assert len(in_memory) == 41
    assert same(in_memory, mapped) and same(in_memory, again)
    assert decoded == [43, 43]
    (file,) = (tmp_path / "cache").iterdir()
    assert file.name.startswith("set-")


def test_sets_above_the_memory_limit_go_to_the_users_cache(folder, tmp_path, monkeypatch, decoded):
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "mine"))
    needed = 43 * 3 * 8 * 8
    assert not isinstance(read_images(folder, 8, memory_limit_bytes=needed).images, np.memmap)
    assert isinstance(read_images(folder, 8, memory_limit_bytes=needed - 1).images, np.memmap)
    assert len(list((tmp_path / "mine").iterdir())) == 1


def test_user_folder_of_this_system(monkeypatch, tmp_path):
    monkeypatch.delenv("DERENDER_CACHE", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "derender"


def change_content(folder: Path, encoded) -> None:
    (folder / "cat/05.png").write_bytes(encoded(999))


def add_a_picture(folder: Path, encoded) -> None:
    (folder / "cat/new.png").write_bytes(encoded(998))


def remove_a_picture(folder: Path, encoded) -> None:
    (folder / "cat/07.png").unlink()


def rename_a_picture(folder: Path, encoded) -> None:
    (folder / "cat/07.png").rename(folder / "cat/99.png")


@pytest.mark.parametrize("change", [change_content, add_a_picture, remove_a_picture, rename_a_picture])
def test_a_changed_source_is_read_again_in_place_of_the_old(folder, tmp_path, decoded, encoded, change):
    read_images(folder, 8, cache=tmp_path / "cache")
    change(folder, encoded)
    after = read_images(folder, 8, cache=tmp_path / "cache")
    assert len(decoded) == 2
    assert same(after, read_images(folder, 8))
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_settings_have_files_of_their_own(folder, tmp_path, decoded):
    options = [{}, {"image_size": 16}, {"fit": "pad"}, {"keep_duplicates": True}, {"limit": 5}]
    for _ in range(2):
        sets = [
            read_images(folder, **{"image_size": 8, **option}, cache=tmp_path / "cache") for option in options
        ]
    assert [len(pictures) for pictures in sets] == [41, 41, 41, 42, 5]
    assert decoded == [43, 43, 43, 43, 5]


def test_a_zip_is_known_by_its_checksums(tree, tmp_path, decoded):
    archive = tree(["1.png", "2.png"], zipped=True)
    first = read_images(archive, 8, cache=tmp_path / "cache")
    os.utime(archive, (1, 1))
    read_images(archive, 8, cache=tmp_path / "cache")
    assert len(decoded) == 1
    tree({"1.png": None, "3.png": None, "2.png": None}, zipped=True)
    assert len(read_images(archive, 8, cache=tmp_path / "cache")) == len(first) + 1
    assert len(decoded) == 2


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "foreign", "note"])
def test_a_damaged_file_is_made_again(folder, tmp_path, decoded, damage):
    expected = read_images(folder, 8)
    read_images(folder, 8, cache=tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    raw = bytearray(file.read_bytes())
    if damage == "cut":
        raw = raw[:-7]
    elif damage == "flip":
        raw[5] ^= 1
    elif damage == "empty":
        raw = bytearray()
    elif damage == "foreign":
        raw = bytearray(b"x" * 5000)
    else:
        raw[raw.rindex(b'"files"') + 1] = ord("x")
    file.write_bytes(bytes(raw))
    assert same(read_images(folder, 8, cache=tmp_path / "cache"), expected)
    assert len(decoded) == 3


def test_an_interrupted_run_leaves_nothing(folder, tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        read_images(folder, 8, cache=tmp_path / "cache", progress=stop)
    assert list((tmp_path / "cache").iterdir()) == []


def test_drafts_of_killed_runs_are_removed_after_a_day(folder, tmp_path):
    read_images(folder, 8, cache=tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    old, young, other = (
        tmp_path / "cache" / name for name in (f".{file.name}-a", f".{file.name}-b", ".other")
    )
    for draft in (old, young, other):
        draft.write_bytes(b"x")
    two_days_ago = time.time() - 2 * 86_400
    os.utime(old, (two_days_ago, two_days_ago))
    os.utime(other, (two_days_ago, two_days_ago))
    file.unlink()
    read_images(folder, 8, cache=tmp_path / "cache")
    assert sorted((tmp_path / "cache").iterdir()) == sorted([young, other, file])


def test_a_map_in_use_is_neither_changed_nor_lost(folder, tmp_path, encoded):
    """Writing to the array changes no file, and a new version does not pull the old one away."""
    pictures = read_images(folder, 8, cache=tmp_path / "cache")
    before = pictures.images[5].copy()
    change_content(folder, encoded)
    read_images(folder, 8, cache=tmp_path / "cache")
    np.testing.assert_array_equal(pictures.images[5], before)
    fresh = read_images(folder, 8, cache=tmp_path / "cache")
    fresh.images[:] = 0
    assert read_images(folder, 8, cache=tmp_path / "cache").images.any()


def test_no_space_says_what_is_needed_and_leaves_nothing(folder, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot keep .* GB of decoded .*No space left.*set DERENDER_CACHE"):
        read_images(folder, 8, cache=tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_file_where_the_folder_should_be(folder, tmp_path):
    (tmp_path / "cache").write_text("in the way")
    with pytest.raises(OSError, match=r"cannot keep .*cache .*set DERENDER_CACHE"):
        read_images(folder, 8, cache=tmp_path / "cache")


def test_only_unreadable_files_keep_nothing(tree, tmp_path):
    source = tree({"a.png": "text", "b.png": "text"})
    with pytest.raises(ValueError, match="none of the 2 images"):
        read_images(source, 8, cache=tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_what_is_left_out_is_remembered(folder, tmp_path):
    for _ in range(2):
        pictures = read_images(folder, 8, cache=tmp_path / "cache")
        assert [asdict(row)["file"] for row in pictures.skipped] == ["dog/bad.png"]
        assert [(row.file, row.first) for row in pictures.duplicates] == [("dog/copy.png", "cat/03.png")]
