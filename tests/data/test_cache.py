"""Large sets in a memory map: the same images as in memory, kept, checked, made again after any change."""

import errno
import os
import time
from pathlib import Path

import numpy as np
import pytest

from derender.data import cache as module
from derender.data import cache_folder, image_set, read_images


@pytest.fixture
def decoded(monkeypatch) -> list[int]:
    """How many images each real decoding read."""
    counts, real = [], image_set.decoded

    def counting(*of, **options):
        counts.append(0)
        for chunk in real(*of, **options):
            counts[-1] += len(chunk)
            yield chunk

    monkeypatch.setattr(image_set, "decoded", counting)
    return counts


@pytest.fixture
def folder(tree, encoded) -> Path:
    files = {f"cat/{row:02d}.png": None for row in range(40)}
    return tree({**files, "dog/bad.png": "text", "dog/copy.png": encoded(3), "dog/one.png": None})


@pytest.fixture
def cached(folder, tmp_path):
    """``cached()`` reads the folder by way of a cache of our own."""
    return lambda **how: read_images(folder, **{"image_size": 8, "cache": tmp_path / "cache", **how})


def same(one, other) -> bool:
    skip = ("images", "labels")
    fields = [{k: v for k, v in vars(s).items() if k not in skip} for s in (one, other)]
    labels = all((one.labels[name] == other.labels[name]).all() for name in one.labels)
    return fields[0] == fields[1] and labels and bool((one.images == other.images).all())


def test_memory_and_map_agree_and_the_map_is_kept(folder, cached, tmp_path, decoded):
    in_memory, mapped, again = read_images(folder, 8), cached(), cached()
    assert isinstance(mapped.images, np.memmap) and not isinstance(in_memory.images, np.memmap)
    assert len(in_memory) == 41 and decoded == [43, 43]
    assert same(in_memory, mapped) and same(in_memory, again)
    assert [row.file for row in again.skipped] == ["dog/bad.png"]
    assert [(row.file, row.first) for row in again.duplicates] == [("dog/copy.png", "cat/03.png")]
    (file,) = (tmp_path / "cache").iterdir()
    assert file.name.startswith("set-")


def test_sets_above_the_memory_limit_go_to_the_users_cache(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "mine"))
    needed = 43 * 3 * 8 * 8
    assert not isinstance(read_images(folder, 8, memory_limit_bytes=needed).images, np.memmap)
    assert isinstance(read_images(folder, 8, memory_limit_bytes=needed - 1).images, np.memmap)
    assert len(list((tmp_path / "mine").iterdir())) == 1
    monkeypatch.delenv("DERENDER_CACHE")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "derender"


@pytest.mark.parametrize("change", ["content", "add", "remove", "rename"])
def test_a_changed_source_is_read_again_in_its_place(folder, cached, decoded, encoded, tmp_path, change):
    """And what was mapped before is neither changed nor lost; writing to it changes no file."""
    before = cached()
    fifth = before.images[5].copy()
    if change in ("content", "add"):
        (folder / ("cat/05.png" if change == "content" else "cat/new.png")).write_bytes(encoded(999))
    elif change == "remove":
        (folder / "cat/07.png").unlink()
    else:
        (folder / "cat/07.png").rename(folder / "cat/99.png")
    after = cached()
    assert len(decoded) == 2 and same(after, read_images(folder, 8))
    np.testing.assert_array_equal(before.images[5], fifth)
    after.images[:] = 0
    assert cached().images.any() and len(list((tmp_path / "cache").iterdir())) == 1


def test_settings_have_files_of_their_own(cached, decoded):
    options = [{}, {"image_size": 16}, {"fit": "pad"}, {"keep_duplicates": True}, {"limit": 5}]
    for _ in range(2):
        assert [len(cached(**option)) for option in options] == [41, 41, 41, 42, 5]
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
def test_a_damaged_file_is_made_again(folder, cached, tmp_path, decoded, damage):
    cached()
    (file,) = (tmp_path / "cache").iterdir()
    raw = bytearray(file.read_bytes())
    raw[5 if damage == "flip" else raw.rindex(b'"files"') + 1] ^= 1
    contents = {"cut": file.read_bytes()[:-7], "empty": b"", "foreign": b"x" * 5000}
    file.write_bytes(contents.get(damage, bytes(raw)))
    assert same(cached(), read_images(folder, 8)) and decoded == [43] * 3


def test_drafts_of_killed_runs_are_removed_after_a_day(cached, tmp_path):
    cached()
    (file,) = (tmp_path / "cache").iterdir()
    names = (f".{file.name}-a", f".{file.name}-b", ".other")
    old, young, other = (tmp_path / "cache" / name for name in names)
    two_days_ago = time.time() - 2 * 86_400
    for draft in (old, young, other):
        draft.write_bytes(b"x")
        if draft is not young:
            os.utime(draft, (two_days_ago, two_days_ago))
    file.unlink()
    cached()
    assert sorted((tmp_path / "cache").iterdir()) == sorted([young, other, file])


def test_interruptions_and_sets_without_a_readable_image_leave_nothing(cached, tree, tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cached(progress=stop)
    with pytest.raises(ValueError, match="none of the 2 images"):
        read_images(tree({"a.png": "text", "b.png": "text"}, name="none"), 8, cache=tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_what_cannot_be_written_says_what_is_needed_and_leaves_nothing(cached, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot keep .* GB of decoded .*No space left.*set DERENDER_CACHE"):
        cached()
    assert list((tmp_path / "cache").iterdir()) == []
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match=r"cannot keep .*file .*set DERENDER_CACHE"):
        cached(cache=tmp_path / "file")
