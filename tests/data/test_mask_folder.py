"""Masks from another folder: by path or by name, classes by number or by name, and what does not fit."""

import numpy as np
import pytest
from PIL import Image

from derender.data import read_masks


@pytest.fixture
def write(tmp_path):
    def write(name: str, array: np.ndarray):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(array).save(file)

    return write


@pytest.fixture
def folders(write, tmp_path):
    random = np.random.default_rng(0)
    for row in range(3):
        write(f"photos/a/{row}.png", random.integers(0, 256, (8, 8, 3), dtype=np.uint8))
        write(f"masks/a/{row}.png", np.full((16, 16), row, np.uint8))
    return tmp_path / "photos", tmp_path / "masks"


def test_masks_lie_beside_their_pictures(folders, write, tmp_path):
    told = []
    pictures, masks, classes = read_masks(
        folders[0], 4, masks=folders[1], progress=lambda *at: told.append(at)
    )
    assert pictures.files == ("a/0.png", "a/1.png", "a/2.png") and told[-1] == (3, 3)
    assert masks.shape == (3, 4, 4) and [set(mask.ravel()) for mask in masks] == [{0}, {1}, {2}]
    assert classes == ("class 0", "class 1", "class 2")
    for row in range(3):
        write(f"flat/{row}.png", np.full((8, 8), row, np.uint8))
    (tmp_path / "flat" / "classes.txt").write_text("sky\nwall\nfloor\ndoor\n")
    named = read_masks(folders[0], 4, masks=tmp_path / "flat")
    assert named.classes == ("sky", "wall", "floor", "door") and (named.masks == masks).all()


def test_names_of_classes_beside_the_folder_of_masks(folders, tmp_path):
    """`derender synth` writes them there; those among the masks come first."""
    (tmp_path / "classes.txt").write_text("sea\nsand\nrock\n")
    assert read_masks(folders[0], 4, masks=folders[1]).classes == ("sea", "sand", "rock")
    (tmp_path / "masks" / "classes.txt").write_text("sky\nwall\nfloor\n")
    assert read_masks(folders[0], 4, masks=folders[1]).classes == ("sky", "wall", "floor")


def test_values_are_never_mixed(folders, write, tmp_path):
    checks = (np.indices((64, 64)).sum(axis=0) % 2 * 7).astype(np.uint8)
    write("masks/a/1.png", checks)
    assert set(read_masks(folders[0], 8, masks=folders[1]).masks[1].ravel().tolist()) <= {0, 7}


def test_what_does_not_fit_is_named(folders, write, tmp_path):
    photos, masks = folders
    (masks / "classes.txt").write_text("sky\nwall\n")
    with pytest.raises(ValueError, match=r"a/2\.png in .* holds the number 2; classes\.txt names 2 classes"):
        read_masks(photos, 4, masks=masks)
    write("masks/a/1.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match=r"a/1\.png in .* has 3 channels; a mask has one"):
        read_masks(photos, 4, masks=masks)
    write("masks/a/1.png", np.full((8, 8), 255, np.uint8))
    with pytest.raises(ValueError, match=r"holds the number 255.*a class of their own"):
        read_masks(photos, 4, masks=masks)
    (masks / "a" / "1.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"a/1\.png in .* cannot be read"):
        read_masks(photos, 4, masks=masks)
    (masks / "a" / "1.png").unlink()
    with pytest.raises(ValueError, match=r"1 of 3 images have no mask in .* 'a/1\.png'"):
        read_masks(photos, 4, masks=masks)
