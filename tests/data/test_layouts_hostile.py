"""Odd and hostile trees, read to the end: names, loops, bombs, unsafe paths."""

import zipfile

import pytest

from derender.data import list_images, read_images, read_masks, zip_source

NAMES = ["ann lee", "ÄÖ ß 日本", "two\nlines", "quote\"'", "tab\there"]


@pytest.mark.parametrize("zipped", [False, True])
def test_names_with_spaces_unicode_and_newlines(tree, zipped):
    pictures = read_images(tree([f"{name}/{name} 1.png" for name in NAMES], zipped), 8)
    assert pictures.layout == "classes"
    assert sorted(pictures.labels["class"]) == sorted(NAMES)
    assert pictures.skipped == ()


@pytest.mark.parametrize("zipped", [False, True])
def test_such_names_in_published_layouts(tree, zipped):
    people = read_images(tree([f"{name}/{name}_0001.jpg" for name in NAMES], zipped), 8)
    assert people.layout == "lfw"
    assert sorted(people.labels["identity"]) == sorted(NAMES)
    files = {"x y.ids": "CVHCI_TRACKLABELS_V1\n3 Ann Lee\n", "x y/03/日本 1.jpg": None}
    assert read_images(tree(files, zipped, name="tracks"), 8).labels["identity"].tolist() == ["Ann Lee"]
    raf = {"list_patition_label.txt": "test_two words.jpg 2\n", "test_two words_aligned.jpg": None}
    assert read_images(tree(raf, zipped, name="raf"), 8).labels["emotion"].tolist() == ["fear"]


def test_loops_of_links_end_in_published_layouts(tree):
    folder = tree({"list_attr_celeba.txt": "1\nBald\n000001.jpg 1\n", "img_align_celeba/000001.jpg": None})
    (folder / "img_align_celeba" / "again").symlink_to(folder, target_is_directory=True)
    (folder / "self").symlink_to("self")
    pictures = read_images(folder, 8)
    assert pictures.files == ("img_align_celeba/000001.jpg",)
    assert [row.file for row in pictures.skipped] == ["self"]


def bomb(path, names, monkeypatch):
    """A zip whose members unpack to more than is allowed."""
    monkeypatch.setattr(zip_source, "FILE_LIMIT_BYTES", 1 << 20)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, bytes(3 << 20))


def test_a_picture_that_is_a_bomb_is_skipped(tree, monkeypatch):
    path = tree(["a.png"], zipped=True)
    bomb(path, ["b.png"], monkeypatch)
    pictures = read_images(path, 8)
    assert pictures.files == ("a.png",)
    assert [row.reason for row in pictures.skipped] == ["unpacks to 3 MiB, more than 1 MiB"]


@pytest.mark.parametrize("name", ["list_attr_celeba.txt", "list_patition_label.txt", "x.ids", "data.csv"])
def test_a_list_that_is_a_bomb_is_an_error(tree, monkeypatch, name):
    path = tree(["1/000001.jpg"], zipped=True)
    bomb(path, [name], monkeypatch)
    with pytest.raises(ValueError, match="unpacks to 3 MiB, more than 1 MiB"):
        list_images(path)


def test_a_mask_that_is_a_bomb_is_an_error(tree, monkeypatch):
    path = tree(["images/0.jpg"], zipped=True)
    bomb(path, ["masks/0.png"], monkeypatch)
    with pytest.raises(ValueError, match=r"masks/0\.png in .* cannot be read: unpacks to 3 MiB"):
        read_masks(path, 8)


def test_unsafe_names_in_a_zip_never_reach_a_layout(tree):
    files = {
        "../list_attr_celeba.txt": "1\nBald\n000001.jpg 1\n",
        "/abs/1.png": None,
        "a/../../2.png": None,
        "good/3.png": None,
    }
    pictures = read_images(tree(files, zipped=True), 8)
    assert (pictures.layout, pictures.files) == ("folder", ("good/3.png",))
    assert len(pictures.skipped) == 3
    assert all("unsafe name in the zip" in row.reason for row in pictures.skipped)
