"""Very large folders: the listing that is remembered is the one a walk finds, and any change is seen."""

import os
from pathlib import Path

import pytest

from derender.data import cache_folder, folder_source, list_images, opening
from derender.data.folder_source import FolderSource


@pytest.fixture
def walks(monkeypatch, tmp_path) -> list[str]:
    """Folders of 30 files count as very large, in a cache of our own; which folders were walked."""
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 30)
    monkeypatch.setattr(folder_source, "_SETTLED_NS", -(10**12))
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))
    walked, real = [], folder_source.list_files
    monkeypatch.setattr(folder_source, "list_files", lambda root: walked.append(root) or real(root))
    return walked


@pytest.fixture
def folder(tree, walks) -> Path:
    root = tree(
        [f"{kind}/ä{row:02d}.png" for kind in ("cat", "dog") for row in range(20)]
        + ["notes.csv", "cat/x.tmp"]
    )
    (root / "loop").symlink_to(root)
    (root / "gone.png").symlink_to(root / "nowhere")
    (root / os.fsdecode(b"raw\xff.png")).write_bytes(b"x")
    return root


def known(source: FolderSource) -> tuple[object, ...]:
    stamps = source.stamps(source.files).tolist()
    source.remember()
    return source.files, source.skipped, stamps


def test_what_is_remembered_is_what_a_walk_finds(folder, walks):
    first = known(FolderSource(folder))
    assert walks == [str(folder)] and len(list(cache_folder().glob("*.listing"))) == 1
    again = FolderSource(folder)
    assert known(again) == first and len(walks) == 1
    assert again.read("raw\\xff.png") == b"x"
    status = (folder / "cat" / "ä03.png").stat()
    assert again.stamps(["cat/ä03.png"]).tolist() == [[status.st_size, status.st_mtime_ns]]
    assert [row.file for row in again.skipped] == ["gone.png"]


def test_the_layout_is_recognised_once(folder, walks, monkeypatch):
    (folder / os.fsdecode(b"raw\xff.png")).unlink()
    asked, real = [], opening.recognise
    monkeypatch.setattr(opening, "recognise", lambda source: asked.append(1) or real(source))
    for _ in range(2):
        with list_images(folder) as found:
            assert found.layout == "classes"
    assert len(asked) == 1 and len(walks) == 1


def add(folder: Path) -> None:
    (folder / "cat" / "new.png").write_bytes(b"x")


def remove(folder: Path) -> None:
    (folder / "dog" / "ä07.png").unlink()


def rename(folder: Path) -> None:
    (folder / "dog" / "ä07.png").rename(folder / "dog" / "b.png")


def new_folder(folder: Path) -> None:
    (folder / "bird").mkdir()


def write_over_a_table(folder: Path) -> None:
    (folder / "notes.csv").write_text("other words")


def write_over_many(folder: Path) -> None:
    for file in (folder / "cat").glob("*.png"):
        file.write_bytes(b"other bytes")


@pytest.mark.parametrize("change", [add, remove, rename, new_folder, write_over_a_table, write_over_many])
def test_a_change_is_seen(folder, walks, change):
    known(FolderSource(folder))
    change(folder)
    after = known(FolderSource(folder))
    assert len(walks) == 2
    for kept in cache_folder().glob("*.listing"):
        kept.unlink()
    assert known(FolderSource(folder)) == after


@pytest.mark.parametrize("damage", [b"", b"junk", None])
def test_a_damaged_listing_is_made_again(folder, walks, damage):
    first = known(FolderSource(folder))
    (kept,) = cache_folder().glob("*.listing")
    kept.write_bytes(kept.read_bytes()[:-100] if damage is None else damage)
    assert known(FolderSource(folder)) == first and len(walks) == 2
    assert known(FolderSource(folder)) == first and len(walks) == 2


def test_what_changed_a_moment_ago_is_not_trusted(folder, walks, monkeypatch):
    monkeypatch.setattr(folder_source, "_SETTLED_NS", 10**10)
    known(FolderSource(folder))
    FolderSource(folder)
    assert len(walks) == 2


def test_small_folders_and_a_cache_that_cannot_be_written(folder, walks, monkeypatch, tmp_path):
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 100)
    known(FolderSource(folder))
    assert not cache_folder().exists()
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 30)
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "file"))
    assert known(FolderSource(folder)) and known(FolderSource(folder))
