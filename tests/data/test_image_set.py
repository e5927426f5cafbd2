"""read_images from end to end: order, labels aligned with what was kept, copies, faults, progress."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.conftest import noise

from derender.data import as_float, read_image, read_images


@pytest.mark.parametrize(("zipped", "workers"), [(False, 1), (False, 4), (True, 4)])
def test_images_in_the_order_of_their_names(tree, encoded, zipped, workers):
    names = [f"{row:03d}.png" for row in range(100)]
    images = read_images(tree(names, zipped), 8, workers=workers)
    assert images.files == tuple(names)
    assert images.images.dtype == np.uint8
    assert images.images.shape == (100, 3, 8, 8)
    for row in (0, 31, 32, 99):
        np.testing.assert_array_equal(images.images[row], read_image(encoded(row), 8))


def test_one_image_file_and_sizes_and_modes_mixed(tree, encoded):
    grey, clear = np.full((20, 30), 70, np.uint8), np.zeros((5, 7, 4), np.uint8)
    large = encoded(np.zeros((300, 200, 3), np.uint8), "JPEG")
    folder = tree({"a.png": encoded(grey), "b.png": encoded(clear), "c.png": None, "d.jpg": large})
    assert read_images(folder, 8).images.shape == (4, 3, 8, 8)
    images = read_images(folder / "c.png", 8)
    assert images.files == ("c.png",) and images.require(1) is images
    with pytest.raises(ValueError, match="training needs 2 images or more, and only one image was found in"):
        images.require(2)


def test_unreadable_files_are_skipped_with_reasons_and_labels_stay_aligned(tree, encoded):
    files = {"cat/1.png": None, "cat/2.png": "no image", "cat/3.png": None, "dog/2.png": None}
    files |= {"dog/1.jpg": encoded(noise(0, 99, 99), "JPEG")[:800], "dog/3.png": b""}
    images = read_images(tree(files), 8)
    assert images.files == ("cat/1.png", "cat/3.png", "dog/2.png")
    assert images.label("class").tolist() == ["cat", "cat", "dog"]
    reasons = {row.file: row.reason for row in images.skipped}
    assert set(reasons) == {"cat/2.png", "dog/1.jpg", "dog/3.png"}
    assert reasons["cat/2.png"] == "not an image in a known format"
    assert "truncated" in reasons["dog/1.jpg"]
    assert reasons["dog/3.png"] == "empty file"
    for row, seed in enumerate((0, 2, 3)):
        np.testing.assert_array_equal(images.images[row], read_image(encoded(seed), 8))
    assert "3 images" in images.describe() and "3 skipped" in images.describe()


def test_copies_are_dropped_by_content(tree, encoded):
    """The same pixels in another format are the same image."""
    one = encoded(1)
    files = {"cat/1.png": one, "cat/2.png": encoded(2), "dog/1.bmp": encoded(1, "BMP"), "dog/2.png": one}
    source = tree(files)
    images = read_images(source, 12)
    assert images.files == ("cat/1.png", "cat/2.png")
    copies = [(row.file, row.first) for row in images.duplicates]
    assert copies == [("dog/1.bmp", "cat/1.png"), ("dog/2.png", "cat/1.png")]
    assert "2 identical copies dropped" in images.describe()
    kept = read_images(source, 12, keep_duplicates=True)
    assert len(kept) == 4 and kept.duplicates == images.duplicates
    assert "2 identical copies kept" in kept.describe()


def test_nothing_or_too_little_that_can_be_read(tree, encoded):
    with pytest.raises(ValueError, match=r"none of the 2 images in .* the first is 'a\.png': not an image"):
        read_images(tree({"a.png": "text", "b.jpg": "text"}, name="none"), 8)
    images = read_images(tree({"a.png": encoded(1), "b.png": encoded(1), "c.png": "text"}), 8)
    with pytest.raises(ValueError, match=r"only one image was .* \(2 more were unreadable or identical"):
        images.require(2)


def test_progress_counts_up_to_the_total(tree):
    source, calls = tree([f"{row}.png" for row in range(70)]), []
    read_images(source, 8, progress=lambda *call: calls.append(call))
    assert calls == [(32, 70), (64, 70), (70, 70)]


def test_select_and_label(tree):
    files = ["train/cat/1.png", "train/dog/1.png", "test/cat/2.png", "test/dog/3.png"]
    images = read_images(tree(files), 8)
    for rows in ([3, 0], np.array([3, 0])):
        chosen = images.select(rows)
        assert chosen.files == (images.files[3], images.files[0])
        assert chosen.labels["class"].tolist() == ["dog", "cat"]
        assert chosen.partition.tolist() == ["train", "test"]
        np.testing.assert_array_equal(chosen.images, images.images[[3, 0]])
    assert images.select(images.partition == "test").files == images.files[:2]
    assert np.shares_memory(images.select(slice(1, 3)).images, images.images)
    assert len(images.select([])) == 0
    message = r"\(classes\) has no label 'clas'; did you mean 'class'\?; it has class"
    with pytest.raises(ValueError, match=message):
        images.label("clas")
    with pytest.raises(ValueError, match="it has no labels"):
        replace(images, labels={}).label("class")
    with pytest.raises(ValueError, match="4 images, but 3 values in 'age'"):
        replace(images, labels={"age": np.zeros(3)})


@pytest.mark.parametrize(
    ("option", "message"), [({"image_size": 0}, "image_size must be in"), ({"limit": 0}, "limit")]
)
def test_bad_options(tree, option, message):
    with pytest.raises(ValueError, match=message):
        read_images(tree(["1.png"]), **{"image_size": 8, **option})


def test_as_float():
    images = np.array([0, 51, 255], np.uint8).reshape(1, 3, 1, 1)
    images.setflags(write=False)
    for given in (images, torch.from_numpy(images.copy())):
        tensor = as_float(given)
        assert tensor.dtype == torch.float32
        torch.testing.assert_close(tensor.flatten(), torch.tensor([0, 0.2, 1]))
    tensor += 1
    assert images.max() == 255
