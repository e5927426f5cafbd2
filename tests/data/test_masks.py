"""Masks in both layouts: the published order of parts, nearest resizing, and masks that do not fit."""

import io

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import noise

from derender.data import MASK_CLASSES, list_images, read_masks
from derender.data.layouts.celeba import CELEBAMASK

MAPPING = (
    "idx orig_idx         orig_file\n"
    "0       119613       119614.jpg\n1       162769       162770.jpg\n2       182637       182638.jpg\n"
)
ATTRIBUTES = "2\nBald Smiling \n0.jpg  -1  1\n1.jpg   1 -1\n"


def picture(seed: int, size: int = 32) -> bytes:
    return png(noise(seed, size, size))


def png(array: np.ndarray, mode: str | None = None) -> bytes:
    stored = io.BytesIO()
    image = Image.fromarray(array)
    (image if mode is None else image.convert(mode)).save(stored, "PNG")
    return stored.getvalue()


def part(rows: slice, columns: slice, size: int = 16, mode: str = "L") -> bytes:
    """One part as published: white on black, half the image's size."""
    mask = np.zeros((size, size), np.uint8)
    mask[rows, columns] = 255
    return png(mask, mode)


@pytest.fixture
def published() -> dict[str, bytes | str]:
    """Face 0: skin everywhere but the first row, hair over its right half, glasses above hair's middle."""
    return {
        "CelebAMask-HQ/CelebA-HQ-img/0.jpg": picture(0),
        "CelebAMask-HQ/CelebA-HQ-img/1.jpg": picture(1),
        "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00000_skin.png": part(slice(1, 16), slice(0, 16)),
        "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00000_hair.png": part(slice(0, 8), slice(8, 16), mode="RGB"),
        "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00000_eye_g.png": part(slice(4, 6), slice(0, 16)),
        "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00001_cloth.png": part(slice(12, 16), slice(0, 16)),
        "CelebAMask-HQ/README.txt": "non-commercial\n",
    }


@pytest.fixture
def merged() -> dict[str, bytes]:
    numbers = np.arange(32 * 32).reshape(32, 32) % 19
    files = {f"images/{row}.jpg": picture(row) for row in range(3)}
    return files | {f"masks/{row}.png": png(((numbers + row) % 19).astype(np.uint8)) for row in range(3)}


def test_the_classes_are_the_owners():
    assert len(MASK_CLASSES) == 19
    assert [MASK_CLASSES.index(name) for name in ("background", "skin", "eye_g", "hair", "cloth")] == [
        0,
        1,
        3,
        13,
        18,
    ]


@pytest.mark.parametrize("zipped", [False, True])
def test_parts_are_merged_in_the_published_order(tree, published, zipped):
    pictures, masks, classes = read_masks(tree(published, zipped), 16)
    assert pictures.layout == "celebamask"
    assert classes == MASK_CLASSES
    expected = np.ones((16, 16), np.uint8)
    expected[0] = 0
    expected[4:6] = 3
    expected[:8, 8:] = 13  # hair hides skin and glasses
    assert (masks[0] == expected).all()
    assert np.unique(masks[1]).tolist() == [0, 18]
    assert (masks[1] == 18).sum() == 4 * 16


@pytest.mark.parametrize("zipped", [False, True])
def test_merged_masks_are_resized_to_the_nearest_value(tree, merged, zipped):
    result = read_masks(tree(merged, zipped), 16)
    for row in range(3):
        whole = np.asarray(Image.open(io.BytesIO(merged[f"masks/{row}.png"])))
        inside = whole.reshape(16, 2, 16, 2).transpose(0, 2, 1, 3).reshape(16, 16, 4)
        assert (result.masks[row][..., None] == inside).any(axis=-1).all()
    same = read_masks(tree(merged, zipped), 32)
    assert (same.masks[1] == np.asarray(Image.open(io.BytesIO(merged["masks/1.png"])))).all()
    assert same.masks.dtype == np.uint8


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
def test_a_mask_stays_on_its_picture(tree, fit):
    """An image that is painted as its mask: after any fit, bright is where the class is."""
    mask = np.zeros((40, 64), np.uint8)
    mask[10:30, 20:50] = 13
    bright = np.repeat((mask[..., None] > 0).astype(np.uint8) * 255, 3, axis=-1)
    small = png(np.ascontiguousarray(mask[::2, ::2]))
    pictures, masks, _ = read_masks(tree({"images/0.png": png(bright), "masks/0.png": small}), 64, fit=fit)
    shown = pictures.images[0].mean(axis=0) > 127
    if fit == "pad":  # white above and below the image is no hair
        shown[:12] = shown[52:] = False
    assert (shown == (masks[0] == 13)).mean() > 0.97
    assert (masks[0] == 13).sum() > 500


def test_a_palette_holds_class_numbers(tree, merged):
    image = Image.fromarray(np.full((32, 32), 7, np.uint8)).convert("P")
    image = Image.frombytes("P", (32, 32), bytes([7] * 1024))
    image.putpalette([200, 10, 30] * 256)
    stored = io.BytesIO()
    image.save(stored, "PNG")
    assert (read_masks(tree({**merged, "masks/0.png": stored.getvalue()}), 8).masks[0] == 7).all()


def test_rows_belong_together_when_some_are_left_out(tree, merged):
    """A copy, an unreadable image and a limit take their masks with them."""
    files = {**merged, "images/3.jpg": merged["images/0.jpg"], "masks/3.png": merged["masks/0.png"]}
    pictures, masks, _ = read_masks(tree({**files, "images/1.jpg": b"no picture"}), 32)
    assert pictures.files == ("images/0.jpg", "images/2.jpg")
    assert (masks[1] == np.asarray(Image.open(io.BytesIO(merged["masks/2.png"])))).all()
    assert len(pictures.duplicates) == len(pictures.skipped) == 1
    seen = []
    limited = read_masks(
        tree(files), 8, limit=2, keep_duplicates=True, progress=lambda *step: seen.append(step)
    )
    assert (len(limited.images), limited.masks.shape) == (2, (2, 8, 8))
    assert seen == [(2, 2), (1, 2), (2, 2)]


def test_official_parts_and_attributes(tree, published):
    files = {
        **published,
        "CelebAMask-HQ/CelebA-HQ-img/2.jpg": picture(2),
        "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00002_skin.png": part(slice(0, 9), slice(0, 9)),
        "CelebAMask-HQ/CelebA-HQ-to-CelebA-mapping.txt": MAPPING,
        "CelebAMask-HQ/CelebAMask-HQ-attribute-anno.txt": ATTRIBUTES,
    }
    source = tree(files)
    found = read_masks(source, 8)
    assert found.images.partition.tolist() == ["train", "train", "test"]
    assert found.images.labels["Bald"].tolist() == [0, 1, -1]
    assert [file[-5:] for file in read_masks(source, 8, subset="test").images.files] == ["2.jpg"]
    assert len(read_masks(f"{source}::train", 8).masks) == 2
    with pytest.raises(ValueError, match="no part 'validation': its parts are test, train"):
        read_masks(source, 8, subset="validation")


def test_attributes_by_way_of_celebas_own_list(tree, published):
    files = {
        **published,
        "CelebA-HQ-to-CelebA-mapping.txt": MAPPING,
        "list_attr_celeba.txt": "1\nBald Young\n119614.jpg 1 -1\n",
        "list_eval_partition.txt": "119614.jpg 1\n",
    }
    pictures = read_masks(tree(files), 8).images
    assert pictures.layout == "celebamask"
    assert (pictures.labels["Bald"].tolist(), pictures.labels["Young"].tolist()) == ([1, -1], [0, -1])
    assert pictures.partition.tolist() == ["validation", ""]


def test_a_picture_without_a_mask_is_a_picture_but_has_no_mask(tree, merged):
    source = tree({**merged, "images/9.jpg": picture(9)})
    inventory = list_images(source, dataset="celebamask")
    inventory.files.close()
    assert inventory.table.labels["mask"].tolist() == ["masks/0.png", "masks/1.png", "masks/2.png", ""]
    with pytest.raises(ValueError, match=r"1 of 4 images in .* have no mask, the first is 'images/9\.jpg'"):
        read_masks(source, 8, dataset="celebamask")


def wide(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.tile(array, (1, 2)))


ZERO = np.zeros((32, 32), np.uint8)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            png(ZERO + 19),
            r"masks/1\.png in .* holds the number 19; classes are 0 \(background\) to 18 \(cloth\)",
        ),
        (png(ZERO.astype(np.uint16) + 300), "holds the number 300; classes are 0"),
        (png(wide(ZERO)), r"is 64 x 32 and its image images/1\.jpg 32 x 32: a mask has the aspect ratio"),
        (png(ZERO, "RGB"), "has 3 channels; a mask has one, of class numbers"),
        (b"no picture", r"masks/1\.png in .* cannot be read"),
        (png(noise(1, channels=1))[:90], r"masks/1\.png in .* cannot be read"),
    ],
    ids=["class 19", "class 300", "wide", "colours", "text", "cut"],
)
def test_a_mask_that_does_not_fit_is_named(tree, merged, content, message):
    with pytest.raises(ValueError, match=message):
        read_masks(tree({**merged, "masks/1.png": content}), 8)


def test_parts_of_two_sizes(tree, published):
    files = {
        **published,
        "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00000_nose.png": part(slice(0), slice(0), 12),
    }
    with pytest.raises(ValueError, match=r"is (12 x 12|16 x 16), other parts of the face are not"):
        read_masks(tree(files), 8)


def test_half_unpacked_sets_say_what_is_missing(tree, published):
    pictures = {name: content for name, content in published.items() if "img" in name}
    parts = {name: content for name, content in published.items() if "anno" in name}
    with pytest.raises(
        ValueError, match=rf"none of their masks: expected CelebAMask-HQ-mask-anno/.*{CELEBAMASK.home}"
    ):
        list_images(tree(pictures), dataset="celebamask")
    with pytest.raises(ValueError, match=r"no images of CelebAMask-HQ: expected CelebA-HQ-img/0\.jpg"):
        list_images(tree(parts, name="parts"), dataset="celebamask")


def test_a_damaged_mapping_is_named(tree, published):
    for text, line in (("0 1 2.jpg\n", 1), (MAPPING + "3 x\n", 5), (MAPPING.replace("119614", "x"), 2)):
        files = {**published, "CelebA-HQ-to-CelebA-mapping.txt": text}
        with pytest.raises(
            ValueError, match=rf"mapping\.txt in .*, line {line}: expected idx orig_idx orig_file"
        ):
            list_images(tree(files))


def test_a_set_without_masks_says_as_what_it_was_read(tree):
    with pytest.raises(
        ValueError, match=r"holds no masks \(it was read as folder\): expected images/NAME\.jpg"
    ):
        read_masks(tree(["1.png"]), 8)


def test_parts_and_class_numbers_say_the_same(tree):
    """A mask decomposed into one image per class, as published, is put together again."""
    numbers = np.random.default_rng(0).integers(0, 19, (2, 16, 16)).astype(np.uint8)
    files = {f"CelebA-HQ-img/{row}.jpg": picture(row, 16) for row in range(2)}
    for row, mask in enumerate(numbers):
        for number in range(1, 19):
            name = f"CelebAMask-HQ-mask-anno/0/{row:05d}_{MASK_CLASSES[number]}.png"
            files[name] = png((mask == number).astype(np.uint8) * 255)
    assert (read_masks(tree(files), 16).masks == numbers).all()
