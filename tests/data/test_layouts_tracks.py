"""Face tracks: the published lists of The Big Bang Theory and Buffy, and folders of people and tracks."""

import pytest

from derender.data import list_images, read_pictures
from derender.data.layouts.tracks import HOME

BUFFY = "CVHCI_TRACKLABELS_V1\n1 giles\n13 buffy\n52 unknown_e02_8\n"
EPISODES = {
    "ids/buffy_s05e02.ids": BUFFY,
    "ids/bbt_s01e01.ids": "CVHCI_TRACKLABELS_V1\n1 penny\n2 sheldon\n",
    "buffy_s05e02/1/0001.jpg": None,
    "buffy_s05e02/13/0001.jpg": None,
    "buffy_s05e02/13/0002.jpg": None,
    "buffy_s05e02/99/0001.jpg": None,
    "bbt_s01e01/00001/a b.jpg": None,
    "notes/cover.jpg": None,
}
NESTED = ["Ann_Lee/0/0.555.jpg", "Ann_Lee/1/0.1.jpg", "Bo/0/0.3.jpg", "Bo/track_002/frame_01.jpg"]


def inventory_of(source, **options):
    inventory = list_images(source, **options)
    inventory.files.close()
    return inventory


@pytest.mark.parametrize("zipped", [False, True])
def test_published_lists(tree, zipped):
    source = tree(EPISODES, zipped)
    inventory = inventory_of(source)
    assert inventory.layout == "face_tracks"
    found = inventory.table
    rows = [tuple(column[row] for column in found.labels.values()) for row in range(len(found.files))]
    assert list(found.labels) == ["identity", "track", "episode", "frame"]
    assert dict(zip(found.files, rows, strict=True)) == {
        "bbt_s01e01/00001/a b.jpg": ("penny", "bbt_s01e01/1", "bbt_s01e01", "a b"),
        "buffy_s05e02/1/0001.jpg": ("giles", "buffy_s05e02/1", "buffy_s05e02", "0001"),
        "buffy_s05e02/13/0001.jpg": ("buffy", "buffy_s05e02/13", "buffy_s05e02", "0001"),
        "buffy_s05e02/13/0002.jpg": ("buffy", "buffy_s05e02/13", "buffy_s05e02", "0002"),
        "buffy_s05e02/99/0001.jpg": ("", "buffy_s05e02/99", "buffy_s05e02", "0001"),
        "notes/cover.jpg": ("", "", "", "cover"),
    }
    one = inventory_of(f"{source}::bbt_s01e01").table
    assert one.labels["identity"].tolist() == ["penny"]
    assert "identity unknown for 2" in read_pictures(source, 8).describe()


def test_one_list_needs_no_folder_of_its_name(tree):
    found = inventory_of(tree({"buffy.ids": BUFFY, "faces/0013/1.jpg": None, "faces/0052/1.jpg": None})).table
    assert found.labels["identity"].tolist() == ["buffy", "unknown_e02_8"]
    assert found.labels["track"].tolist() == ["buffy/13", "buffy/52"]


@pytest.mark.parametrize("zipped", [False, True])
def test_people_and_tracks_as_folders(tree, zipped):
    inventory = inventory_of(tree(NESTED, zipped))
    assert inventory.layout == "face_tracks"
    labels = inventory.table.labels
    assert labels["identity"].tolist() == ["Ann_Lee", "Ann_Lee", "Bo", "Bo"]
    assert labels["track"].tolist() == ["Ann_Lee/0", "Ann_Lee/1", "Bo/0", "Bo/track_002"]
    assert labels["frame"].tolist() == ["0.555", "0.1", "0.3", "frame_01"]


@pytest.mark.parametrize(
    "files",
    [
        ["cats/siamese/1.jpg", "dogs/pug/2.jpg"],
        ["train/0/1.png", "train/1/2.png", "test/0/3.png"],
        ["one/0/1.png", "one/1/2.png"],
    ],
)
def test_classes_are_not_taken_for_tracks(tree, files):
    assert inventory_of(tree(files)).layout == "classes"


def test_unnumbered_tracks_when_asked_for(tree):
    found = inventory_of(tree(["Ann/kitchen/x.jpg", "Bo/bar/y.jpg"]), dataset="face_tracks").table
    assert found.labels["track"].tolist() == ["Ann/kitchen", "Bo/bar"]
    with pytest.raises(ValueError, match=rf"1\.jpg does not lie in IDENTITY/TRACK/.*NAME\.ids .*{HOME}"):
        list_images(tree(["a/1.jpg"], name="flat"), dataset="face_tracks")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "1 giles\n",
            r"buffy_s05e02\.ids in .*, line 1: expected a first line CVHCI_TRACKLABELS_V1",
        ),
        (BUFFY + "x giles\n", "line 5: .* got 'x giles'"),
        (BUFFY + "14\n", "line 5: .* a track's number and a name"),
        (BUFFY + "13 dawn\n", "line 5: track 13 has two names"),
    ],
)
def test_faults_in_lists_are_named(tree, text, message):
    with pytest.raises(ValueError, match=message):
        list_images(tree({**EPISODES, "ids/buffy_s05e02.ids": text}))


def test_frames_that_no_list_knows(tree):
    with pytest.raises(
        ValueError,
        match=r"none of the images in .* lies in the folder of a track that x\.ids lists .*NUMBER/FRAME",
    ):
        list_images(tree({"x.ids": BUFFY, "77/1.jpg": None, "thirteen/2.jpg": None}))
