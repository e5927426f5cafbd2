"""Very large folders and zips: what is remembered is what a look finds, and any change is seen."""

import os
import zipfile
from pathlib import Path

import pytest

import derender
from derender.data import cache_folder, folder_source, list_images, opening, zip_source

NAMES = [f"{kind}/ä{row:02d}.png" for kind in ("cat", "dog") for row in range(20)]
KINDS = pytest.mark.parametrize("kind", ["folder", "zip"])


@pytest.fixture
def looks(monkeypatch, tmp_path) -> list[int]:
    """Sources of 30 files count as very large, in a cache of our own; every time one was listed anew."""
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 30)
    monkeypatch.setattr(folder_source, "_SETTLED_NS", -(10**12))
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))
    counted: list[int] = []
    for module, name in ((folder_source, "list_files"), (zip_source, "members_of")):
        real = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *of, real=real: counted.append(1) or real(*of))
    return counted


@pytest.fixture
def large(tree, looks):
    """``large("folder")`` or ``large("zip")``: forty images, and what is no image."""

    def make(kind: str) -> Path:
        if kind == "zip":
            return tree([*NAMES, "notes.csv", "../out.png", "a\\b.txt"], zipped=True)
        root = tree([*NAMES, "notes.csv", "cat/x.tmp"])
        (root / "loop").symlink_to(root)
        (root / "gone.png").symlink_to(root / "nowhere")
        (root / os.fsdecode(b"cat/raw\xff.png")).write_bytes(b"x")
        return root

    return make


def known(path: Path, **options: str) -> tuple[object, ...]:
    """Everything there is to know of a source, its files' bytes included."""
    with list_images(path, **options) as found:
        files = found.files
        stamps = files.stamps(files.files).tolist()
        assert files.stamps(files.images).tolist() == [stamps[files.row_of(file)] for file in files.images]
        contents = [files.read(file) for file in files.files]
        return found.layout, files.files, files.skipped, stamps, contents, found.identity()


@KINDS
def test_what_is_remembered_is_what_a_look_finds(large, looks, kind, monkeypatch):
    path, asked, real = large(kind), [], opening.recognise
    monkeypatch.setattr(opening, "recognise", lambda source: asked.append(1) or real(source))
    assert known(path, dataset="folder")[0] == "folder" and not asked
    first = known(path)
    assert known(path) == first and first[0] == "classes"
    assert len(looks) == len(asked) == len(list(cache_folder().glob("*.listing"))) == 1
    assert ("a/b.txt" in first[1]) if kind == "zip" else ("cat/raw\\xff.png" in first[1])
    assert [row.file for row in first[2]] == ["../out.png" if kind == "zip" else "gone.png"]


IN_FOLDER = {
    "add": lambda folder: (folder / "cat" / "new.png").write_bytes(b"x"),
    "remove": lambda folder: (folder / "dog" / "ä07.png").unlink(),
    "rename": lambda folder: (folder / "dog" / "ä07.png").rename(folder / "dog" / "b.png"),
    "new folder": lambda folder: (folder / "bird").mkdir(),
    "write over a table": lambda folder: (folder / "notes.csv").write_text("other words"),
    "write over many": lambda folder: [one.write_bytes(b"other") for one in (folder / "cat").glob("*.png")],
}
IN_ZIP = {  # of a table the size, name and place stay
    "add": lambda contents: contents | {"cat/new.png": b"x"},
    "remove": lambda contents: {name: one for name, one in contents.items() if name != NAMES[0]},
    "rename": lambda contents: {name.replace("ä07", "b"): one for name, one in contents.items()},
    "write over a table": lambda contents: contents | {"notes.csv": contents["notes.csv"][::-1]},
}


@pytest.mark.parametrize(
    ("kind", "change"),
    [*(("folder", change) for change in IN_FOLDER), *(("zip", change) for change in IN_ZIP)],
)
def test_a_change_is_seen(large, looks, kind, change):
    path = large(kind)
    before = known(path)
    if kind == "folder":
        IN_FOLDER[change](path)
    else:
        with zipfile.ZipFile(path) as archive:
            contents = IN_ZIP[change]({name: archive.read(name) for name in archive.namelist()})
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in contents.items():
                archive.writestr(name, content)
    after = known(path)
    assert len(looks) == 2 and (after != before or change == "new folder")
    for listing in cache_folder().glob("*.listing"):
        listing.unlink()
    assert known(path) == after


@KINDS
@pytest.mark.parametrize("damage", ["empty", "junk", "cut", "one bit", "version"])
def test_a_damaged_listing_or_one_of_another_version_is_made_again(large, looks, kind, damage, monkeypatch):
    path = large(kind)
    first = known(path)
    (listing,) = cache_folder().glob("*.listing")
    whole = listing.read_bytes()
    changed = bytearray(whole)
    changed[len(changed) // 2] ^= 1
    contents = {"empty": b"", "junk": b"junk", "cut": whole[:-100], "one bit": bytes(changed)}
    listing.write_bytes(contents.get(damage, whole))
    if damage == "version":
        monkeypatch.setattr(derender, "__version__", "0.0.0")
    assert known(path) == first and len(looks) == 2
    assert known(path) == first and len(looks) == 2


def test_what_changed_a_moment_ago_is_not_trusted(large, looks, monkeypatch):
    monkeypatch.setattr(folder_source, "_SETTLED_NS", 10**10)
    path = large("folder")
    assert known(path) == known(path) and len(looks) == 2


@KINDS
def test_small_sources_and_a_cache_that_cannot_be_written(large, kind, monkeypatch, tmp_path):
    path = large(kind)
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 100)
    known(path)
    assert not cache_folder().exists()
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 30)
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "file"))
    assert known(path) == known(path)
    with opening.open_source(path) as source, pytest.raises(ValueError, match=r"zzz is not in"):
        source.stamps(["zzz"])
