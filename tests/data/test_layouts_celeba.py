"""CelebA as its owners publish it: lists, official parts, and pictures in the wild cropped to their face."""

import numpy as np
import pytest
from tests.data.conftest import noise

from derender.data import list_images, read_pictures
from derender.data.image import decode

ATTRIBUTES = "3\nBald Smiling \n" + "".join(f"00000{row}.jpg -1  1\n" for row in (1, 2, 3))
PARTITION = "000001.jpg 0\n000002.jpg 1\n000003.jpg 2\n"
LANDMARKS = (
    "2\nlefteye_x lefteye_y righteye_x righteye_y nose_x nose_y "
    "leftmouth_x leftmouth_y rightmouth_x rightmouth_y\n"
    "000001.jpg  20 30 30 30 25 35 21 40 29 40\n"
    "000002.jpg  20 30 24 30 22 35 20 40 24 40\n"
)
BOXES = "2\nimage_id x_1 y_1 width height\n000001.jpg    5  6 20  30\n000002.jpg   5  6 40  30\n"
WILD = {
    **{f"Img/img_celeba/00000{row}.jpg": None for row in (1, 2, 3)},
    "Anno/list_attr_celeba.txt": ATTRIBUTES,
    "Eval/list_eval_partition.txt": PARTITION,
}


def table(source, **options):
    inventory = list_images(source, **options)
    inventory.files.close()
    assert inventory.layout == "celeba"
    return inventory.table


@pytest.mark.parametrize("zipped", [False, True])
def test_in_the_wild_by_landmarks(tree, zipped):
    """Eyes' middle (25, 30), 10 apart; mouth's 10 below: side max(40, 36), middle 1 above the eyes."""
    found = table(
        tree({**WILD, "Anno/list_landmarks_celeba.txt": LANDMARKS, "a/list_bbox_celeba.txt": BOXES}, zipped)
    )
    assert found.boxes[0].tolist() == [5, 9, 45, 49]
    assert found.boxes[1] == pytest.approx([22 - 18, 29 - 18, 22 + 18, 29 + 18])
    assert np.isnan(found.boxes[2]).all()
    assert found.partition.tolist() == ["train", "validation", "test"]


def test_in_the_wild_by_the_owners_box(tree):
    found = table(tree({**WILD, "Anno/list_bbox_celeba.txt": BOXES}))
    assert found.boxes[:2].tolist() == [[0, 6, 30, 36], [5, 1, 45, 41]]
    assert table(tree({**WILD, "Anno/list_bbox_celeba.txt": BOXES}), subset="val").boxes.tolist() == [
        [5, 1, 45, 41]
    ]


def test_the_pictures_are_the_boxes_and_one_without_is_listed(tree, encoded, tmp_path):
    contents = {f"Img/img_celeba/00000{row}.jpg": encoded(noise(row, 60, 50)) for row in (1, 2, 3)}
    source = tree({**WILD, **contents, "Anno/list_bbox_celeba.txt": BOXES})
    for options in ({}, {"cache": tmp_path / "cache"}, {"cache": tmp_path / "cache"}):
        pictures = read_pictures(source, 10, **options)
        assert [row.file for row in pictures.skipped] == ["Img/img_celeba/000003.jpg"]
        assert "no usable box is known" in pictures.skipped[0].reason
        assert pictures.files == ("Img/img_celeba/000001.jpg", "Img/img_celeba/000002.jpg")
        for row, sides in enumerate(([0, 6, 30, 36], [5, 1, 45, 41])):
            file = f"Img/img_celeba/00000{row + 1}.jpg"
            assert (
                pictures.images[row] == decode(contents[file], 10, "crop", np.array(sides, np.float32))
            ).all()
    one = read_pictures(source, 10, limit=1)
    assert (one.images[0] == pictures.images[0]).all()


def test_other_boxes_are_other_rows_in_the_cache(tree, encoded, tmp_path):
    contents = {f"Img/img_celeba/00000{row}.jpg": encoded(noise(row, 60, 50)) for row in (1, 2, 3)}
    before = tree({**WILD, **contents, "Anno/list_bbox_celeba.txt": BOXES})
    first = read_pictures(before, 10, cache=tmp_path / "cache").images.copy()
    tree({"Anno/list_bbox_celeba.txt": BOXES.replace(" 5  6 20  30", " 9  6 20  30")})
    second = read_pictures(before, 10, cache=tmp_path / "cache").images
    assert (first[0] != second[0]).any() and (first[1] == second[1]).all()


def test_aligned_pictures_come_before_those_in_the_wild(tree):
    found = table(tree({**WILD, "Img/img_align_celeba/000001.jpg": None}))
    assert found.files == ("Img/img_align_celeba/000001.jpg",)
    assert found.boxes is None


def test_in_the_wild_without_boxes_names_what_is_missing(tree):
    with pytest.raises(
        ValueError,
        match=r"neither list_landmarks_celeba\.txt nor list_bbox_celeba\.txt; the owners publish both at h",
    ):
        list_images(tree(WILD))


def test_half_unpacked(tree):
    with pytest.raises(
        ValueError, match=r"list of attributes and no images: expected img_align_celeba or img_celeba"
    ):
        list_images(tree({"list_attr_celeba.txt": ATTRIBUTES, "img_align_celeba.zip": "x"}))


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (
            "list_eval_partition.txt",
            "000001.jpg 3\n",
            r"line 1: .* 1 values of 0 \(train\), .* got '000001",
        ),
        ("list_eval_partition.txt", "000001.jpg 0\n000002.jpg\n", "line 2: expected a name and 1 values"),
        (
            "list_eval_partition.csv",
            "image_id,partition\n000001.jpg,7\n",
            r"line 2: .* of 0 .* got '000001.jpg,7",
        ),
        ("identity_CelebA.txt", "000001.jpg 2880 x\n", "line 1: expected a name and 1 values"),
        ("list_bbox_celeba.txt", BOXES.replace("width", "w"), "has no column 'width'; its columns are x_1"),
        ("list_bbox_celeba.txt", BOXES.replace("40", "forty"), "holds something that is no number"),
        ("list_landmarks_celeba.txt", LANDMARKS.replace("2\n", "9\n", 1), "says 9 rows and it has 2"),
    ],
)
def test_faults_in_the_lists_are_named(tree, file, text, message):
    wild = {name: content for name, content in WILD.items() if not name.startswith("Eval")}
    with pytest.raises(ValueError, match=message):
        list_images(tree({**wild, "Anno/list_bbox_celeba.txt": BOXES, f"Anno/{file}": text}))


def test_the_copies_as_csv(tree):
    """As they are on Kaggle."""
    files = {
        "img_align_celeba/img_align_celeba/000001.jpg": None,
        "list_attr_celeba.csv": "image_id,Bald\n000001.jpg,1\n",
        "list_eval_partition.csv": "image_id,partition\n000001.jpg,2\n",
        "list_bbox_celeba.csv": "image_id,x_1,y_1,width,height\n000001.jpg,95,71,226,313\n",
    }
    found = table(tree(files))
    assert (found.labels["Bald"].tolist(), found.partition.tolist(), found.boxes) == ([1], ["test"], None)


def test_subsets_are_the_official_parts(tree):
    source = tree({**WILD, "Anno/list_bbox_celeba.txt": BOXES})
    assert table(f"{source}::test").files == ("Img/img_celeba/000003.jpg",)
    with pytest.raises(ValueError, match=r"no subset 'tests'; there are test, train, validation"):
        list_images(source, subset="tests")
    alone = {name: content for name, content in WILD.items() if "partition" not in name}
    with pytest.raises(
        ValueError, match=r"no official split, so no subset 'test': list_eval_partition\.txt is missing"
    ):
        list_images(tree({**alone, "Anno/list_bbox_celeba.txt": BOXES}, name="alone"), subset="test")
