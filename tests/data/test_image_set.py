"""read_images from end to end: order, labels aligned with what was kept, copies, faults, progress."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from derender.data import as_float, read_image, read_images


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("workers", [1, 4])
def test_pictures_in_the_order_of_their_names(tree, encoded, zipped, workers):
    names = [f"{row:03d}.png" for row in range(100)]
    pictures = read_images(tree(names, zipped), 8, workers=workers)
    assert pictures.files == tuple(names)
    assert pictures.images.dtype == np.uint8
    assert pictures.images.shape == (100, 3, 8, 8)
    for row in (0, 31, 32, 99):
        np.testing.assert_array_equal(pictures.images[row], read_image(encoded(row), 8))


def test_one_picture_file(tree):
    folder = tree(["1.png", "2.png"])
    pictures = read_images(folder / "2.png", 8)
    assert pictures.files == ("2.png",)
    with pytest.raises(ValueError, match="training needs 2 images or more, and only one image was found in"):
        pictures.require(2)
    assert pictures.require(1) is pictures


def test_mixed_sizes_and_modes_become_one_array(tree, encoded):
    files = {
        "a.png": encoded(np.full((20, 30), 70, np.uint8)),
        "b.png": encoded(np.zeros((5, 7, 4), np.uint8)),
        "c.png": None,
        "d.jpg": encoded(np.zeros((300, 200, 3), np.uint8), "JPEG"),
    }
    pictures = read_images(tree(files), 8)
    assert pictures.images.shape == (4, 3, 8, 8)


def test_unreadable_files_are_skipped_with_reasons_and_labels_stay_aligned(tree, encoded):
    jpeg = encoded(np.random.default_rng(0).integers(0, 256, (99, 99, 3), dtype=np.uint8), "JPEG")
    files = {
        "cat/1.png": None,
        "cat/2.png": "no image",
        "cat/3.png": None,
        "dog/1.jpg": jpeg[:800],
        "dog/2.png": None,
        "dog/3.png": b"",
    }
    pictures = read_images(tree(files), 8)
    assert pictures.files == ("cat/1.png", "cat/3.png", "dog/2.png")
    assert pictures.label("class").tolist() == ["cat", "cat", "dog"]
    reasons = {row.file: row.reason for row in pictures.skipped}
    assert set(reasons) == {"cat/2.png", "dog/1.jpg", "dog/3.png"}
    assert reasons["cat/2.png"] == "not an image in a known format"
    assert "truncated" in reasons["dog/1.jpg"]
    assert reasons["dog/3.png"] == "empty file"
    for row, seed in enumerate((0, 2, 4)):
        np.testing.assert_array_equal(pictures.images[row], read_image(encoded(seed), 8))
    assert "3 images" in pictures.describe() and "3 skipped" in pictures.describe()


def test_copies_are_dropped_by_content(tree, encoded):
    """The same pixels in another format are the same image."""
    files = {
        "cat/1.png": encoded(1),
        "cat/2.png": encoded(2),
        "dog/1.bmp": encoded(1, "BMP"),
        "dog/2.png": encoded(1),
    }
    source = tree(files)
    pictures = read_images(source, 12)
    assert pictures.files == ("cat/1.png", "cat/2.png")
    assert [(row.file, row.first) for row in pictures.duplicates] == [
        ("dog/1.bmp", "cat/1.png"),
        ("dog/2.png", "cat/1.png"),
    ]
    assert "2 identical copies dropped" in pictures.describe()
    kept = read_images(source, 12, keep_duplicates=True)
    assert len(kept) == 4
    assert kept.duplicates == pictures.duplicates
    assert "2 identical copies kept" in kept.describe()


def test_only_unreadable_files(tree):
    source = tree({"a.png": "text", "b.jpg": "text"})
    with pytest.raises(ValueError, match=r"none of the 2 images in .* the first is 'a\.png': not an image"):
        read_images(source, 8)


def test_a_copy_of_one_picture_is_too_few(tree, encoded):
    pictures = read_images(tree({"a.png": encoded(1), "b.png": encoded(1), "c.png": "text"}), 8)
    with pytest.raises(
        ValueError, match=r"only one image was found in .* \(2 more were unreadable or identical"
    ):
        pictures.require(2)


def test_limit_takes_evenly_spaced_pictures(tree):
    pictures = read_images(tree([f"{row}.png" for row in range(10)]), 8, limit=4)
    assert pictures.files == ("0.png", "3.png", "6.png", "9.png")


def test_progress_counts_up_to_the_total(tree):
    calls = []
    read_images(
        tree([f"{row}.png" for row in range(70)]), 8, progress=lambda done, total: calls.append((done, total))
    )
    assert [total for _, total in calls] == [70] * len(calls)
    assert [done for done, _ in calls] == [32, 64, 70]


def test_an_error_in_progress_ends_the_work(tree):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        read_images(tree([f"{row}.png" for row in range(70)]), 8, progress=stop)


def test_select(tree):
    pictures = read_images(
        tree(["train/cat/1.png", "train/dog/1.png", "test/cat/2.png", "test/dog/3.png"]), 8
    )
    for rows in ([3, 0], np.array([3, 0])):
        chosen = pictures.select(rows)
        assert chosen.files == (pictures.files[3], pictures.files[0])
        assert chosen.labels["class"].tolist() == ["dog", "cat"]
        assert chosen.partition.tolist() == ["train", "test"]
        np.testing.assert_array_equal(chosen.images, pictures.images[[3, 0]])
    assert pictures.select(pictures.partition == "test").files == pictures.files[:2]
    assert np.shares_memory(pictures.select(slice(1, 3)).images, pictures.images)
    assert len(pictures.select([])) == 0


def test_unknown_label_names_those_there_are(tree):
    pictures = read_images(tree(["cat/1.png", "dog/1.png"]), 8)
    with pytest.raises(
        ValueError, match=r"\(classes\) has no label 'clas'; did you mean 'class'\?; it has class"
    ):
        pictures.label("clas")
    with pytest.raises(ValueError, match="it has no labels"):
        read_images(tree(["1.png"], name="plain"), 8).label("class")


def test_misaligned_columns_are_refused(tree):
    pictures = read_images(tree(["1.png", "2.png"]), 8)
    with pytest.raises(ValueError, match="2 images, but 3 values in 'age'"):
        replace(pictures, labels={"age": np.zeros(3)})


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
    tensor = as_float(images)
    tensor += 1
    assert images.max() == 255
