"""RAF-DB and LFW's official parts, on trees as their owners publish them."""

import pytest
from PIL import Image

from derender.data import list_images, read_pictures
from derender.data.layouts.faces import EMOTIONS, RAFDB

RAF = {
    "basic/EmoLabel/list_patition_label.txt": "".join(f"train_{row:05d}.jpg {row}\n" for row in range(1, 8))
    + "test_0001.jpg 4\n",
    **{f"basic/Image/aligned/train_{row:05d}_aligned.jpg": None for row in range(1, 9)},
    "basic/Image/aligned/test_0001_aligned.jpg": None,
    "basic/Image/original/train_00001.jpg": None,
    "compound/EmoLabel/list_patition_label.txt": "train_0001.jpg 11\n",
}
LFW = {
    "lfw-deepfunneled/Ann_Lee/Ann_Lee_0001.jpg": None,
    "lfw-deepfunneled/Bo/Bo_0001.jpg": None,
    "lfw-deepfunneled/Cy_X/Cy_X_0001.jpg": None,
    "peopleDevTrain.txt": "2\nAnn_Lee\t1\nOther\t3\n",
    "peopleDevTest.txt": "1\nBo\t1\n",
    "pairs.txt": "10\t300\nBo\t1\t4\n",
}


def table(source, **options):
    inventory = list_images(source, **options)
    inventory.files.close()
    return inventory.table


@pytest.mark.parametrize("zipped", [False, True])
def test_rafdb(tree, zipped):
    """Aligned pictures only; the eighth has no row."""
    source = tree(RAF, zipped)
    found = table(source)
    by_name = dict(zip([file[-18:-12] for file in found.files], found.labels["emotion"], strict=True))
    assert [by_name[f"_{row:05d}"] for row in range(1, 9)] == [*EMOTIONS, ""]
    assert EMOTIONS[0] == "surprise" and EMOTIONS[6] == "neutral"
    assert sorted(found.partition.tolist()) == ["test"] + ["train"] * 8
    test = table(f"{source}::test")
    assert (test.files, test.labels["emotion"].tolist()) == (
        ("basic/Image/aligned/test_0001_aligned.jpg",),
        ["happiness"],
    )
    with pytest.raises(ValueError, match="no subset 'val'; there are test, train"):
        list_images(source, subset="val")


def test_rafdb_with_the_list_spelt_right(tree):
    files = {"list_partition_label.txt": "test_1.jpg 1\n", "aligned/test_1_aligned.jpg": None}
    assert table(tree(files)).labels["emotion"].tolist() == ["surprise"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "train_00001.jpg 5\ntrain_00002.jpg 8\n",
            r"line 2: expected an image and an emotion from 1 \(surprise\)",
        ),
        ("train_00001.jpg 0\n", r"to 7 \(neutral\), got 'train_00001\.jpg 0'"),
        ("5\n", r"line 1: expected an image and an emotion"),
        (
            "other.jpg 5\n",
            "names none of its images; the first is 'basic/Image/aligned/test_0001_aligned.jpg'",
        ),
    ],
)
def test_faults_in_rafdbs_list_are_named(tree, text, message):
    with pytest.raises(ValueError, match=message):
        list_images(tree({**RAF, "basic/EmoLabel/list_patition_label.txt": text}))


def test_rafdb_half_unpacked(tree):
    packed = {"basic/EmoLabel/list_patition_label.txt": "train_00001.jpg 5\n", "basic/Image/aligned.zip": "x"}
    with pytest.raises(ValueError, match=r"no aligned images: expected Image/aligned/.* unpack aligned\.zip"):
        list_images(tree(packed))
    with pytest.raises(
        ValueError, match=rf"no EmoLabel/list_patition_label\.txt .* on request: {RAFDB.home}"
    ):
        list_images(tree(["aligned/test_1_aligned.jpg"], name="bare"), dataset="rafdb")


@pytest.mark.parametrize("zipped", [False, True])
def test_lfw_by_the_people_of_view_1(tree, zipped):
    source = tree(LFW, zipped)
    found = table(source)
    assert found.labels["identity"].tolist() == ["Ann_Lee", "Bo", "Cy_X"]
    assert found.partition.tolist() == ["train", "test", ""]
    assert table(source, subset="test").labels["identity"].tolist() == ["Bo"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("3\nBo\t1\n", r"peopleDevTest\.txt in .* is cut short: 1 people of 3"),
        ("", "line 1: expected the number of people"),
        ("1\nBo x\n", "line 2: .* a name and a number of images"),
    ],
)
def test_faults_in_lfws_lists_are_named(tree, text, message):
    with pytest.raises(ValueError, match=message):
        list_images(tree({**LFW, "peopleDevTest.txt": text}))


def test_lfw_without_lists_has_no_parts(tree):
    files = [name for name in LFW if name.endswith("jpg")]
    assert table(tree(files)).partition is None
    with pytest.raises(ValueError, match=r"no images in a folder 'test'"):
        list_images(tree(files), subset="test")


def test_a_published_set_says_on_whose_terms_it_is_read(tmp_path):
    Image.new("RGB", (8, 8), (200, 20, 20)).save(tmp_path / "plain.png")
    assert read_pictures(tmp_path, 8).terms == ""
    chips = tmp_path / "UTKFace"
    chips.mkdir()
    Image.new("RGB", (8, 8), (20, 200, 20)).save(chips / "30_1_0_20170117000000000.jpg.chip.jpg")
    assert "research" in read_pictures(chips, 8, dataset="utkface").terms
