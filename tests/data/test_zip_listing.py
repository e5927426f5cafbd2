"""Very large zips: what is remembered is what the archive holds, and any change to it is seen."""

import os
import zipfile
from pathlib import Path

import pytest
from tests.data.zips import packed, set_in_directory

import derender
from derender.data import cache_folder, listing, take_inventory, zip_listing
from derender.data import inventory as inventory_module
from derender.data.cache import fingerprint
from derender.data.source import ZipSource


@pytest.fixture
def parsed(monkeypatch, tmp_path) -> list[int]:
    """Zips of 30 members are very large, in a cache of our own; the directories that were taken apart."""
    monkeypatch.setattr(listing, "REMEMBERED_FROM", 30)
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))
    counted, real = [], zip_listing.members_of

    def counting(directory):
        counted.append(len(directory.content))
        return real(directory)

    monkeypatch.setattr(zip_listing, "members_of", counting)
    return counted


@pytest.fixture
def archive(tree, parsed) -> Path:
    names = [f"{kind}/ä{row:02d}.png" for kind in ("cat", "dog") for row in range(20)]
    return tree([*names, "notes.csv", "../out.png", "secret.txt", "a\\b.txt"], zipped=True)


def known(path: Path, **options: str) -> tuple[object, ...]:
    """Everything there is to know of a zip, its members' bytes included."""
    with (found := take_inventory(path, **options)).source as source:
        mark = fingerprint(source, source.files, ())
        stamps = [source.stamp(file) for file in source.files]
        assert source.stamps(source.files).tolist() == [list(stamp) for stamp in stamps]
        assert source.stamps(source.pictures).tolist() == [list(source.stamp(f)) for f in source.pictures]
        contents = [source.read(file) for file in source.files]
        return found.layout.name, source.files, source.skipped, stamps, contents, mark


def test_what_is_remembered_is_what_the_archive_holds(archive, parsed):
    locked = set_in_directory(archive.read_bytes(), "secret.txt", 8, b"\1")
    archive.write_bytes(locked)
    first = known(archive)
    assert len(parsed) == 1 and len(list(cache_folder().glob("*.listing"))) == 1
    assert known(archive) == first and len(parsed) == 1
    assert first[0] == "classes" and len(first[1]) == 42 and "a/b.txt" in first[1]
    assert [row.file for row in first[2]] == ["../out.png", "secret.txt"]


def test_the_layout_is_recognised_once(archive, parsed, monkeypatch):
    asked, real = [], inventory_module.recognise
    monkeypatch.setattr(inventory_module, "recognise", lambda source: asked.append(1) or real(source))
    assert known(archive, dataset="folder")[0] == "folder" and not asked
    assert known(archive)[0] == known(archive)[0] == "classes"
    assert known(archive, dataset="folder")[0] == "folder"
    assert len(asked) == 1 and len(parsed) == 1


def add(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("cat/new.png", b"x")


def remove(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist() if name != "dog/ä07.png"}
    path.write_bytes(packed(contents))


def rename(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace("dog/ä07.png".encode(), "dog/ä7x.png".encode()))


def write_over_one(path: Path) -> None:
    """The same size, name and place, and the same time of change."""
    before = path.stat()
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    contents["notes.csv"] = contents["notes.csv"][::-1]
    path.write_bytes(packed(contents, zipfile.ZIP_STORED))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    after = path.stat()
    assert (after.st_size, after.st_mtime_ns, after.st_ino) == (
        before.st_size,
        before.st_mtime_ns,
        before.st_ino,
    )


def put_something_before(path: Path) -> None:
    path.write_bytes(b"a program" + path.read_bytes())


@pytest.mark.parametrize("change", [add, remove, rename, write_over_one, put_something_before])
def test_a_change_is_seen(archive, parsed, change):
    before = known(archive)
    change(archive)
    after = known(archive)
    assert len(parsed) == 2 and (after != before) == (change is not put_something_before)
    for kept in cache_folder().glob("*.listing"):
        kept.unlink()
    assert known(archive) == after


@pytest.mark.parametrize("damage", ["empty", "junk", "cut", "one bit"])
def test_a_damaged_listing_is_made_again(archive, parsed, damage):
    first = known(archive)
    (kept,) = cache_folder().glob("*.listing")
    content = bytearray(kept.read_bytes())
    content[len(content) // 2] ^= 1
    whole = kept.read_bytes()
    kept.write_bytes({"empty": b"", "junk": b"junk", "cut": whole[:-100], "one bit": bytes(content)}[damage])
    assert known(archive) == first and len(parsed) == 2
    assert known(archive) == first and len(parsed) == 2


def test_another_archive_or_version_is_not_trusted(archive, parsed, monkeypatch):
    first = known(archive)
    monkeypatch.setattr(derender, "__version__", "0.0.0")
    assert known(archive) == first and len(parsed) == 2
    archive.unlink()
    archive.write_bytes(packed({f"{row}.png": b"x" for row in range(40)}))
    with ZipSource(archive) as other:
        assert len(other.files) == 40 and len(parsed) == 3


def test_small_zips_and_a_cache_that_cannot_be_written(archive, parsed, monkeypatch, tmp_path):
    monkeypatch.setattr(listing, "REMEMBERED_FROM", 100)
    known(archive)
    assert not cache_folder().exists()
    monkeypatch.setattr(listing, "REMEMBERED_FROM", 30)
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "file"))
    assert known(archive) == known(archive) and len(parsed) == 3


def test_a_member_that_is_not_there(archive, parsed):
    with ZipSource(archive) as source:
        for name in ("", "cat/ä", "zzz"):
            with pytest.raises(ValueError, match=r"is not in .*set\.zip"):
                source.read(name)
