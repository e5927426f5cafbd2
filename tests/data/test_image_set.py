"""read_images from end to end: order, labels aligned with what was kept, copies, faults; and splits."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tests.data.conftest import noise

from derender.data import ImageSet, as_float, read_image, read_images, split_indices


@pytest.mark.parametrize(("zipped", "workers"), [(False, 1), (False, 4), (True, 4)])
def test_images_in_the_order_of_their_names(tree, encoded, zipped, workers):
    names, calls = [f"{row:03d}.png" for row in range(100)], []
    images = read_images(tree(names, zipped), 8, workers=workers, progress=lambda *call: calls.append(call))
    assert calls == [(32, 100), (64, 100), (96, 100), (100, 100)]
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
    assert "2 identical copies dropped" in images.describe() == repr(images)
    kept = read_images(source, 12, keep_duplicates=True)
    assert len(kept) == 4 and kept.duplicates == images.duplicates
    assert "2 identical copies kept" in kept.describe()


def test_nothing_or_too_little_that_can_be_read(tree, encoded):
    with pytest.raises(ValueError, match=r"none of the 2 images in .* the first is 'a\.png': not an image"):
        read_images(tree({"a.png": "text", "b.jpg": "text"}, name="none"), 8)
    images = read_images(tree({"a.png": encoded(1), "b.png": encoded(1), "c.png": "text"}), 8)
    with pytest.raises(ValueError, match=r"only one image was .* \(2 more were unreadable or identical"):
        images.require(2)


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
    ("call", "message"),
    [
        (lambda: read_images("photos", 0), "image_size must be in"),
        (lambda: read_images("photos", 8, limit=0), "limit must be 1 or more"),
        (lambda: split_indices(10, (0.8, 0.1, 0.2)), r"add up to 1, got \(0\.8, 0\.1, 0\.2\)"),
        (lambda: split_indices(10, (1.5, -0.5, 0.0)), "add up to 1"),
        (lambda: split_indices(10, groups=["a", "b", "c"]), "one group for each of 10 images, got 3"),
        (
            lambda: ImageSet.__post_init__(SimpleNamespace(images=np.zeros((1, 3, 4, 4), np.float32))),
            r"images must be bytes \(uint8\) of 0..255, got float32",  # types unchecked
        ),
    ],
)
def test_what_cannot_be_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_as_float():
    images = np.array([0, 51, 255], np.uint8).reshape(1, 3, 1, 1)
    images.setflags(write=False)
    for one in (images, torch.from_numpy(images.copy())):
        tensor = as_float(one)
        assert tensor.dtype == torch.float32
        torch.testing.assert_close(tensor.flatten(), torch.tensor([0, 0.2, 1]))
    tensor += 1
    assert images.max() == 255


NAMES = [f"face_{row}.jpg" for row in range(1000)]


def parts(split):
    return split.train, split.validation, split.test


@given(
    st.integers(0, 60),
    st.sampled_from([(0.8, 0.1, 0.1), (0.5, 0.25, 0.25), (1, 0, 0), (0, 0, 1), (0.7, 0.3, 0)]),
)
def test_every_row_once_in_the_right_numbers(count, fractions):
    result = parts(split_indices(count, fractions, seed=3))
    assert sorted(np.concatenate(result).tolist()) == list(range(count))
    for part, fraction in zip(result, fractions, strict=True):
        assert abs(len(part) - count * fraction) < 1
        assert (np.diff(part) > 0).all()


def test_known_answer():
    """Pinned, so that no version or machine may split otherwise than the one that made a published number."""
    assert [len(part) for part in parts(split_indices(NAMES, seed=0))] == [800, 100, 100]
    overlap = np.intersect1d(split_indices(NAMES, seed=0).test, split_indices(NAMES, seed=1).test)
    assert len(overlap) < 30
    assert split_indices(NAMES[:20], seed=1).test.tolist() == [0, 19]
    assert split_indices(NAMES[:20], seed=1).validation.tolist() == [4, 7]


def test_added_files_move_few_others():
    before = split_indices(NAMES, seed=0)
    after = split_indices([*NAMES, *(f"new_{row}.jpg" for row in range(10))], seed=0)
    moved = sum(len(np.setdiff1d(a, b)) for a, b in zip(parts(before), parts(after), strict=True))
    assert moved <= 20


def test_groups_stay_together():
    people = [f"person {row // 7}" for row in range(1000)]
    split = split_indices(NAMES, seed=2, groups=people)
    sets = [{people[row] for row in part} for part in parts(split)]
    assert not (sets[0] & sets[1] or sets[0] & sets[2] or sets[1] & sets[2])
    assert [len(part) for part in parts(split)] == pytest.approx([800, 100, 100], abs=7)


def test_rows_of_unknown_group_stand_alone():
    unknown = split_indices(NAMES, seed=2, groups=[""] * 1000)
    assert [len(part) for part in parts(unknown)] == [800, 100, 100]
    as_numbers = split_indices(NAMES, seed=2, groups=np.full(1000, np.nan))
    np.testing.assert_array_equal(unknown.test, as_numbers.test)
