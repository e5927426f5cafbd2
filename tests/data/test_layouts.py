"""Every layout on a tiny tree as its owners publish it: recognised, named, labels read, faults named."""

import math

import numpy as np
import pytest

from derender.data import LAYOUTS, list_images

ATTRIBUTES = ["Bald", "Smiling", "Young"]

UTKFACE = [
    "UTKFace/100_1_0_20170110183726390.jpg.chip.jpg",
    "UTKFace/24_0_1_20170116220224657 .jpg.chip.jpg",
    "UTKFace/39_1_20170116174525125.jpg.chip.jpg",
    "UTKFace/55_0_9_20170116232725357jpg.chip.jpg",
]
LFW = [
    "lfw-deepfunneled/Ann_Lee/Ann_Lee_0001.jpg",
    "lfw-deepfunneled/Ann_Lee/Ann_Lee_0002.jpg",
    "lfw-deepfunneled/Bo/Bo_0001.jpg",
]
CELEBA = {
    "img_align_celeba/000001.jpg": None,
    "img_align_celeba/000002.jpg": None,
    "img_align_celeba/000003.jpg": None,
    "list_attr_celeba.txt": "2\nBald Smiling Young \n000001.jpg -1  1  1\n000002.jpg  1 -1 -1\n",
}
PARAMS = "file,identity,expression,strength,ambient,diffuse,light_pitch,light_yaw,pitch,yaw,roll,tx,ty\n"
SYNFACE = {
    "train/images/000000.jpg": None,
    "train/images/000001.jpg": None,
    "train/params.csv": PARAMS
    + "images/000000.jpg,7,happy,0.5,0.3,0.6,30,-45,10,20,5,0.001,-0.002\n"
    + "images/000001.jpg,8,sad,,0.3,0.6,0,0,0,0,0,0,0\n",
    "test_gt/images/000000.jpg": None,
    "test_gt/depth/000000.png": None,
    "test_gt/params.csv": PARAMS + "images/000000.jpg,9,fear,0.5,0.3,0.6,0,0,0,0,0,0,0\n",
    "identities.csv": "identity\n7\n",
}
SYNCAR = {
    "train/images/000000.jpg": None,
    "train/params.csv": "file,class,model,elev\nimages/000000.jpg,taxi,a/b,90\n",
    "test/images/000000.jpg": None,
    "test/params.csv": "file,class,model,elev\nimages/000000.jpg,police,a/c,45\n",
}
TRACKS = ["tracks/id1/track_000/000.jpg", "tracks/id1/track_001/000.jpg", "tracks/id2/track_000/000.jpg"]
MASKS = ["images/0.jpg", "images/1.jpg", "masks/0.png", "masks/1.png"]
RAFDB = {
    "basic/EmoLabel/list_patition_label.txt": "train_00001.jpg 5\ntest_0001.jpg 7\n",
    "basic/Image/aligned/train_00001_aligned.jpg": None,
    "basic/Image/aligned/test_0001_aligned.jpg": None,
}
CARS = {
    "02958343/train/1a2b3c4d5e6f708192a3b4c5d6e7f809_000.png": None,
    "02958343/test/0a2b3c4d5e6f708192a3b4c5d6e7f80_001.png": None,
}
FACE_TRACKS = {
    "buffy_s05e02.ids": "CVHCI_TRACKLABELS_V1\n1 giles\n13 buffy\n",
    "buffy_s05e02/00001/0001.jpg": None,
    "buffy_s05e02/00013/0001.jpg": None,
}

TREES = {
    "utkface": UTKFACE,
    "lfw": LFW,
    "celeba": CELEBA,
    "celebamask": MASKS,
    "synface": SYNFACE,
    "syncar": SYNCAR,
    "synface_tracks": TRACKS,
    "rafdb": RAFDB,
    "depth_pairs": ["train/image/1.png", "train/depth/1.png", "test/image/1.png", "test/depth/1.png"],
    "shapenet_cars": CARS,
    "face_tracks": FACE_TRACKS,
    "table": {"data.csv": "file,kind\na b/1.png,x\n2.png,y\n", "a b/1.png": None, "2.png": None},
    "classes": ["cats/1.png", "cats/2.png", "dogs/1.png"],
    "folder": ["1.png", "a/2.png", "b/c/3.png"],
}


def table(source, **options):
    inventory = list_images(source, **options)
    inventory.files.close()
    return inventory.table


def test_every_layout_has_a_tree():
    assert set(TREES) == {layout.name for layout in LAYOUTS}


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("name", TREES)
def test_recognised_wherever_the_tree_lies(tree, name, zipped, wrapped):
    """As published, and inside a folder that an archive program added."""
    files = TREES[name] if isinstance(TREES[name], dict) else dict.fromkeys(TREES[name])
    if wrapped:
        files = {f"download/{file}": content for file, content in files.items()}
    inventory = list_images(tree(files, zipped))
    inventory.files.close()
    assert inventory.layout == name
    for column in inventory.table.labels.values():
        assert len(column) == len(inventory.table.files) > 0


def test_every_published_set_says_where_it_is_and_on_what_terms():
    published = {layout.name for layout in LAYOUTS if layout.home}
    assert published >= {"utkface", "celeba", "celebamask", "lfw", "rafdb", "face_tracks", "shapenet_cars"}
    for layout in LAYOUTS:
        assert bool(layout.home) == bool(layout.terms), layout.name
        assert not layout.home or layout.home.startswith("http"), layout.name


def test_utkface_labels_and_missing_race(tree):
    found = table(tree(UTKFACE))
    assert found.labels["age"].tolist() == [100, 24, 39, 55]
    assert found.labels["age"].dtype == np.float32
    assert found.labels["gender"].tolist() == ["female", "male", "female", "male"]
    assert found.labels["race"].tolist() == ["white", "black", "", ""]


def test_utkface_codes_out_of_range_are_unknown(tree):
    """117 is older than anybody there, genders are 0 and 1; one published name has no gender at all."""
    names = ["117_0_0", "116_3_4", "53__0", "7_1_5"]
    found = table(tree([f"{name}_20170116184028385.jpg" for name in names]))
    by_name = dict(zip([file.rsplit("_", 1)[0] for file in found.files], range(4), strict=True))
    rows = [by_name[name] for name in names]
    assert np.isnan(found.labels["age"][rows]).tolist() == [True, False, False, False]
    assert found.labels["gender"][rows].tolist() == ["male", "", "", "female"]
    assert found.labels["race"][rows].tolist() == ["white", "other", "white", ""]


def test_a_stray_name_among_utkface_has_no_labels(tree):
    files = [f"{age}_0_2_20170110183726390.jpg.chip.jpg" for age in range(1, 20)]
    found = table(tree([*files, "stray.jpg"]))
    row = found.files.index("stray.jpg")
    assert np.isnan(found.labels["age"][row])
    assert (found.labels["gender"][row], found.labels["race"][row]) == ("", "")
    assert np.isnan(found.labels["age"]).sum() == 1


def test_lfw_identity_and_emotion(tree):
    plain = table(tree(LFW))
    assert plain.labels["identity"].tolist() == ["Ann_Lee", "Ann_Lee", "Bo"]
    assert set(plain.labels) == {"identity"}
    emotions = "file,emotion\nAnn_Lee_0002.jpg,happiness\n"
    found = table(tree({**dict.fromkeys(LFW), "emotions.csv": emotions}, name="with_emotions"))
    assert found.labels["emotion"].tolist() == ["", "happiness", ""]


def test_celeba_attributes_with_a_missing_row(tree):
    found = table(tree(CELEBA))
    assert list(found.labels) == ATTRIBUTES
    assert [found.labels[name].tolist() for name in ATTRIBUTES] == [[0, 1, -1], [1, 0, -1], [1, 0, -1]]
    assert found.labels["Bald"].dtype == np.int8
    assert found.partition is None


def test_celeba_csv_identity_and_partition(tree):
    files = {file: content for file, content in CELEBA.items() if not file.endswith(".txt")} | {
        "list_attr_celeba.csv": "image_id,Bald,Smiling\n000001.jpg,-1,1\n000002.jpg,1,-1\n000003.jpg,1,1\n",
        "identity_CelebA.txt": "000001.jpg 2880\n000003.jpg 12\n",
        "list_eval_partition.txt": "000001.jpg 0\n000002.jpg 1\n000003.jpg 2\n",
    }
    source = tree(files)
    found = table(source)
    assert found.labels["Bald"].tolist() == [0, 1, 1]
    assert found.labels["identity"].tolist() == ["2880", "", "12"]
    assert found.partition.tolist() == ["train", "validation", "test"]
    assert table(source, subset="validation").files == ("img_align_celeba/000002.jpg",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "2\nBald Smiling\n000001.jpg -1 1\n000002.jpg 1\n",
            r"line 4: expected a name and 2 values of -1 or 1",
        ),
        ("1\nBald Smiling\n000001.jpg -1 5\n", r"line 3: expected a name and 2 values"),
        ("2\n", "cut short"),
        ("3\nBald\n000001.jpg -1\n", "cut short: its first line says 3 rows and it has 1; copy it again"),
        ("", "cut short"),
    ],
)
def test_celeba_faults_are_named(tree, text, message):
    with pytest.raises(ValueError, match=r"list_attr_celeba\.txt in .*" + message):
        list_images(tree({**CELEBA, "list_attr_celeba.txt": text}))


def test_celeba_without_its_list_says_where_it_is_published(tree):
    files = [file for file in CELEBA if file.endswith("jpg")]
    with pytest.raises(
        ValueError, match=r"has no list_attr_celeba\.txt; CelebA's owners publish it at https"
    ):
        list_images(tree(files), dataset="celeba")


def test_rendered_labels_are_in_radians(tree):
    found = table(tree(SYNFACE))
    assert found.files == ("train/images/000000.jpg", "train/images/000001.jpg")
    assert found.partition.tolist() == ["train", "train"]
    assert found.labels["identity"].tolist() == ["7", "8"]
    assert found.labels["expression"].tolist() == ["happy", "sad"]
    expected = {
        "ambient": 0.3,
        "diffuse": 0.6,
        "light_pitch_rad": math.pi / 6,
        "light_yaw_rad": -math.pi / 4,
        "camera_x_rad": math.pi / 18,
        "camera_y_rad": math.pi / 9,
        "camera_z_rad": math.pi / 36,
        "camera_tx": 0.001,
        "camera_ty": -0.002,
    }
    for name, value in expected.items():
        assert found.labels[name][0] == pytest.approx(value), name
    assert np.isnan(found.labels["strength"][1])


@pytest.mark.parametrize("zipped", [False, True])
def test_rendered_subset_by_name_and_by_suffix(tree, zipped):
    source = tree(SYNFACE, zipped)
    named = table(source, subset="test_gt")
    assert named.files == table(f"{source}::test_gt").files == ("test_gt/images/000000.jpg",)
    assert named.labels["identity"].tolist() == ["9"]
    with pytest.raises(ValueError, match=r"it has no subset 'tests'; there are 'test_gt', 'train'"):
        list_images(source, subset="tests")
    with pytest.raises(ValueError, match=r"names the part 'train', but subset='test_gt' was given too"):
        list_images(f"{source}::train", subset="test_gt")


def test_one_part_of_a_rendered_set_on_its_own(tree):
    found = table(tree(SYNFACE) / "test_gt")
    assert found.files == ("images/000000.jpg",)
    assert found.labels["expression"].tolist() == ["fear"]
    assert found.partition is None


def test_rendered_pictures_without_a_row_have_no_labels(tree):
    found = table(tree({**SYNFACE, "train/images/000002.jpg": None}))
    assert found.labels["identity"].tolist() == ["7", "8", ""]
    assert np.isnan(found.labels["ambient"][2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PARAMS.replace("file", "name"), "has no column 'file'; its columns are name, identity"),
        (PARAMS + "images/000000.jpg,7\n", "line 2: expected 13 values as in the header"),
        (
            PARAMS + "images/000000.jpg" + ",x" * 12 + "\n",
            "column 'strength' holds something that is no number",
        ),
        (PARAMS + "images/000000.jpg" + ",0" * 13 + "\n", "line 2: expected 13 values as in the header"),
        (PARAMS + "x" * 200_000, "is no CSV table"),
        (PARAMS + "images/elsewhere.jpg" + ",0" * 12 + "\n", "names none of the images in train/images"),
    ],
)
def test_rendered_faults_are_named(tree, text, message):
    with pytest.raises(ValueError, match=message):
        list_images(tree({**SYNFACE, "train/params.csv": text}), dataset="synface")


def test_a_csv_with_an_index_column_and_quoted_newlines(tree):
    """As pandas writes it."""
    text = ',file,identity,expression\n0,images/000000.jpg,7,"two\nlines"\n1,images/000001.jpg,8,sad\n'
    found = table(tree({**SYNFACE, "train/params.csv": text}))
    assert found.labels["expression"].tolist() == ["two\nlines", "sad"]
    assert found.labels["identity"].tolist() == ["7", "8"]


def test_syncar_labels(tree):
    found = table(tree(SYNCAR))
    assert (found.labels["class"].tolist(), found.labels["model"].tolist()) == (["taxi"], ["a/b"])
    assert found.labels["elevation_rad"][0] == pytest.approx(math.pi / 2)


def test_tracks(tree):
    found = table(tree(TRACKS))
    assert found.labels["identity"].tolist() == ["id1", "id1", "id2"]
    assert found.labels["track"].tolist() == ["id1/track_000", "id1/track_001", "id2/track_000"]
    with pytest.raises(ValueError, match=r"stray\.jpg does not lie in tracks/IDENTITY/TRACK/"):
        list_images(tree([*TRACKS, "stray.jpg"]), dataset="synface_tracks")


def test_tracks_with_parameters(tree):
    text = PARAMS + f"{TRACKS[2]},1702,happy,1,0.1,0.9,0,90,0,0,0,0,0\n"
    found = table(tree({**dict.fromkeys(TRACKS), "params.csv": text}))
    assert found.labels["expression"].tolist() == ["", "", "happy"]
    assert found.labels["identity"].tolist() == ["id1", "id1", "id2"]
    assert found.labels["light_yaw_rad"][2] == pytest.approx(math.pi / 2)


def test_classes_inside_partitions(tree):
    found = table(tree(["train/cat/1.png", "train/dog/1.png", "test/cat/2.png", "val/dog/4.png"]))
    assert found.labels["class"].tolist() == ["cat", "cat", "dog", "dog"]
    assert found.partition.tolist() == ["test", "train", "train", "validation"]


@pytest.mark.parametrize(
    "files",
    [["train/1.png", "test/2.png"], ["cat/1.png", "dog/2.png", "3.png"], ["only/1.png", "only/2.png"]],
)
def test_what_is_not_one_folder_per_class(tree, files):
    inventory = list_images(tree(files))
    assert inventory.layout == "folder"
    assert inventory.table.labels == {}


def test_partition_of_plain_folders(tree):
    assert table(tree(["Train/1.png", "test/2.png", "3.png"])).partition.tolist() == ["", "train", "test"]


def test_sub_folder_as_subset(tree):
    source = tree(["a/1.png", "a/b/2.png", "c/3.png"])
    assert table(f"{source}::a").files == ("a/1.png", "a/b/2.png")
    assert table(source, subset="b").files == ("a/b/2.png",)
    with pytest.raises(ValueError, match=r"no images in a folder 'd'; its folders are a, c"):
        list_images(source, subset="d")


def test_a_path_that_really_holds_the_separator(tree):
    assert table(tree(["1.png"], name="odd::name")).files == ("1.png",)


def test_named_layout_overrules_recognition(tree):
    source = tree(TREES["classes"])
    inventory = list_images(source, dataset="folder")
    assert (inventory.layout, inventory.table.labels) == ("folder", {})


@pytest.mark.parametrize("name", ["utkface", "synface", "celebamask", "celeba"])
def test_a_named_layout_that_does_not_fit_says_why(tree, name):
    with pytest.raises(ValueError, match="set"):
        list_images(tree(["1.png", "2.png"]), dataset=name)


def test_lfw_needs_folders(tree):
    with pytest.raises(ValueError, match=r"one folder per person, but 1\.png in .* lies in none"):
        list_images(tree(["1.png"]), dataset="lfw")


def test_unknown_layout_names_the_nearest(tree):
    with pytest.raises(
        ValueError, match=r"unknown data set 'utkfaces'; did you mean 'utkface'\? \(known: auto, "
    ):
        list_images(tree(["1.png"]), dataset="utkfaces")


def test_nothing_found_says_what_is_there(tree):
    source = tree({"a.txt": "x", "b.txt": "x", "c.heic": "x", "faces.zip": "x"})
    with pytest.raises(ValueError) as problem:
        list_images(source)
    message = str(problem.value)
    assert f"no images found in {source}: looked for .jpg" in message
    assert "2 of .txt, 1 of .heic, 1 of .zip" in message
    assert "name that file itself" in message


def test_nothing_but_unsafe_names_says_so(tree):
    with pytest.raises(ValueError, match=r"passed over 1, the first is '\.\./1\.png': unsafe name"):
        list_images(tree(["../1.png"], zipped=True))


def test_empty_folder_and_empty_zip(tree, tmp_path):
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", tree([], zipped=True)):
        with pytest.raises(ValueError, match=r"no images found in .*found no files at all"):
            list_images(source)
