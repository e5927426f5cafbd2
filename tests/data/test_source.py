"""Folders, zips and single files: which files are seen, and what odd and hostile ones lead to."""

import os
import zipfile
from pathlib import Path

import pytest

from derender.data import list_images, open_source, read_images, read_masks
from derender.data import source as source_module

ODD = ["ann lee", "ÄÖ ß 日本", "two\nlines", "quote\"'", "tab\there"]
ZIPPED = pytest.mark.parametrize("zipped", [False, True])


@ZIPPED
def test_files_are_sorted_and_hidden_ones_left_out(tree, zipped):
    hidden = [".hidden.png", "__MACOSX/a/._9.png", ".git/x.png", "a/..b/c.png"]
    with open_source(tree(["b/2.png", "a/10.png", "a/9.png", "B/1.png", "n.txt", *hidden], zipped)) as source:
        assert source.files == ("B/1.png", "a/10.png", "a/9.png", "b/2.png", "n.txt")
        assert source.skipped == ()


def test_links_are_followed_once_and_what_cannot_be_read_is_listed(tree):
    folder, outside = tree(["a/1.png", "b/2.png"]), tree(["3.png"], name="outside")
    (folder / "a" / "up").symlink_to(folder, target_is_directory=True)
    (folder / "z").symlink_to(folder / "b", target_is_directory=True)
    (folder / "linked").symlink_to(outside, target_is_directory=True)
    (folder / "gone.png").symlink_to(folder / "nowhere.png")
    (folder / "self").symlink_to("self")
    os.link(folder / "a" / "1.png", folder / "a" / "hard.png")
    os.mkfifo(folder / "pipe.png")
    with open_source(folder) as source:
        assert source.files == ("a/1.png", "a/hard.png", "b/2.png", "linked/3.png")
        assert source.read("a/1.png") == source.read("a/hard.png")
        assert [row.file for row in source.skipped] == ["gone.png", "pipe.png", "self"]
        assert "broken link" in source.skipped[0].reason


def test_a_run_among_the_images_is_left_out(tree):
    run = ["run/config.yaml", "run/environment.json", "run/samples/000000032.png"]
    with open_source(folder := tree(["1.png", *run])) as source:
        assert source.files == ("1.png",) and "a run folder" in source.skipped[0].reason
    with open_source(folder / "run") as source:
        assert source.images == ("samples/000000032.png",), "where it is named it is read"


def test_names_that_are_not_utf8_can_be_stored(tree):
    folder = tree(["1.png"])
    (Path(os.fsdecode(os.fsencode(folder) + b"/\xff.png"))).write_bytes(b"content")
    with open_source(folder) as source:
        assert source.files == ("1.png", "\\xff.png")
        assert source.read("\\xff.png") == b"content"
        "".join(source.files).encode("utf-8")


@ZIPPED
def test_odd_names_reach_every_label(tree, zipped):
    images = read_images(tree([f"{name}/{name} 1.png" for name in ODD], zipped), 8)
    assert images.layout == "classes" and images.skipped == ()
    assert sorted(images.labels["class"]) == sorted(ODD)
    people = read_images(tree([f"{name}/{name}_0001.jpg" for name in ODD], zipped, name="people"), 8)
    assert people.layout == "lfw"
    assert sorted(people.labels["identity"]) == sorted(ODD)
    files = {"x y.ids": "CVHCI_TRACKLABELS_V1\n3 Ann Lee\n", "x y/03/日本 1.jpg": None}
    assert read_images(tree(files, zipped, name="tracks"), 8).labels["identity"].tolist() == ["Ann Lee"]
    raf = {"list_patition_label.txt": "test_two words.jpg 2\n", "test_two words_aligned.jpg": None}
    assert read_images(tree(raf, zipped, name="raf"), 8).labels["emotion"].tolist() == ["fear"]


def bomb(path: Path, name: str, monkeypatch) -> Path:
    """The zip with a member that unpacks to more than is allowed."""
    monkeypatch.setattr(source_module, "FILE_LIMIT_BYTES", 1 << 20)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, bytes(3 << 20))
    return path


BOMBS = ["list_attr_celeba.txt", "list_patition_label.txt", "x.ids", "data.csv", "masks/0.png"]


@pytest.mark.parametrize("name", BOMBS)
def test_a_list_or_mask_that_is_a_bomb_is_an_error(tree, monkeypatch, name):
    path = bomb(tree(["1/000001_aligned.jpg", "images/0.jpg"], zipped=True), name, monkeypatch)
    masks = name.startswith("masks")
    with pytest.raises(ValueError, match=f"{name if masks else ''}.*unpacks to 3 MiB, more than 1 MiB"):
        read_masks(path, 8, dataset="celebamask") if masks else list_images(path)


def test_a_zip_that_is_none_or_cut_is_named(tree, tmp_path):
    whole = tree(["1.png", "2.png"], zipped=True).read_bytes()
    for content in (b"", b"no zip at all", b"PK\x03\x04 cut short", whole[:-30]):
        (tmp_path / "faces.zip").write_bytes(content)
        with pytest.raises(ValueError, match=r"faces\.zip is damaged or not a whole zip file .*again"):
            open_source(tmp_path / "faces.zip")


def test_missing_sources_name_the_nearest_and_others_are_refused(tree, tmp_path):
    folder = tree(["1.png"], name="UTKFace")
    (folder / "11.py").touch()
    (tmp_path / "faces.tar").write_bytes(b"x" * 2000)
    comic = tree(["1.png"], zipped=True).rename(tmp_path / "comic.cbz")
    with open_source(comic) as source:
        assert source.files == ("1.png",)
    comic.write_bytes(comic.read_bytes()[:-1])
    os.mkfifo(tmp_path / "pipe.zip")
    for path, message in (
        (tmp_path / "utkfaces", r"utkfaces does not exist; did you mean 'UTKFace'\?"),
        (folder / "11.pn", r"11\.pn does not exist; did you mean '1\.png'\?"),
        (tmp_path / "no" / "where", "does not exist; nor does its folder"),
        *((tmp_path / name, f"{name} is no folder, zip or image .* unpack")
          for name in ("faces.tar", "comic.cbz", "pipe.zip")),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            open_source(path)


def test_text_must_be_utf8(tree):
    with open_source(tree({"a.csv": b"\xef\xbb\xbffile\n", "b.csv": b"\xe4\n"})) as source:
        assert source.read_text("a.csv") == "file\n"
        with pytest.raises(ValueError, match=r"b\.csv in .* is not UTF-8"):
            source.read_text("b.csv")
