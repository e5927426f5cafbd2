"""Every layout on tiny trees as its owners publish it: recognised, named, labels read, faults named."""

from io import BytesIO
from math import nan, pi

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.data.conftest import noise

from derender.data import LAYOUTS, list_images, read_images
from derender.data.image import decode
from derender.data.layouts.faces import EMOTIONS
from derender.data.layouts.rendered import CAR_CLASSES
from derender.data.layouts.tables import label_column


def images(*names: str) -> dict[str, None]:
    return dict.fromkeys(names)


CHIP = "20170110183726390.jpg"
UTKFACE = images("a/100_1_0_" + CHIP, "a/24_0_1_2017011622022 .jpg", "a/39_1_" + CHIP, "a/55_0_9_" + CHIP)
LFW = images("lfw/Ann_Lee/Ann_Lee_0001.jpg", "lfw/Bo/Bo_0001.jpg", "lfw/Cy_X/Cy_X_0001.jpg")
YALE = images(*(f"CroppedYale/yaleB02/yaleB02_P00A{at}.pgm" for at in ("+000E+00", "-050E+00", "+120E-20")))
VIEW_1 = {"peopleDevTrain.txt": "2\nAnn_Lee\t1\nOther\t3\n", "peopleDevTest.txt": "1\nBo\t1\n"}
ALIGNED = images(*(f"img_align_celeba/00000{row}.jpg" for row in (1, 2, 3)))
ATTRIBUTES = {"list_attr_celeba.txt": "2\nBald Smiling \n000001.jpg -1  1\n000002.jpg  1 -1\n"}
PARTITION = {"list_eval_partition.txt": "000001.jpg 0\n000002.jpg 1\n000003.jpg 2\n"}
WILD = {**images(*(f"img_celeba/00000{row}.jpg" for row in (1, 2, 3))), **ATTRIBUTES}
LANDMARKS = (
    "2\nlefteye_x lefteye_y righteye_x righteye_y nose_x nose_y "
    "leftmouth_x leftmouth_y rightmouth_x rightmouth_y\n"
    "000001.jpg  20 30 30 30 25 35 21 40 29 40\n000002.jpg  20 30 24 30 22 35 20 40 24 40\n"
)
MARKED = {"list_landmarks_celeba.txt": LANDMARKS}
SIDES = "file,left,top,right,bottom\n000001.jpg,2,3,22,33\n000002.jpg,5,1,25,21\n000003.jpg,0,0,40,30\n"
SIZED = "file,left,top,width,height\n000001.jpg,2,3,20,30\n000002.jpg,5,1,20,20\n"
PARAMS = "file,identity,expression,strength,ambient,diffuse,light_pitch,light_yaw,pitch,yaw,roll,tx,ty\n"
FIRST = "images/000000.jpg,7,happy,0.5,0.3,0.6,30,-45,10,20,5,0.001,-0.002\n"
SYNFACE = {
    **images("train/images/000000.jpg", "train/images/000001.jpg", "test_gt/images/000000.jpg"),
    "train/params.csv": PARAMS + FIRST + "images/000001.jpg,8,sad,,0.3,0.6,0,0,0,0,0,0,0\n",
    "test_gt/depth/000000.png": None,
    "test_gt/params.csv": PARAMS + "images/000000.jpg,9,fear,0.5,0.3,0.6,0,0,0,0,0,0,0\n",
    "identities.csv": "identity\n7\n",
}
SYNCAR = {
    **images("train/images/000000.jpg", "test/images/000000.jpg"),
    "train/params.csv": "file,class,model,elev\nimages/000000.jpg,taxi,a/b,90\n",
    "test/params.csv": "file,class,model,elev\nimages/000000.jpg,police,a/c,45\n",
}
TRACKS = images(*(f"tracks/id{at}/000.jpg" for at in ("1/track_000", "1/track_001", "2/track_000")))
RAF = {
    "basic/EmoLabel/list_patition_label.txt": "".join(f"train_{row:05d}.jpg {row}\n" for row in range(1, 8))
    + "test_0001.jpg 4\n",
    **images(*(f"basic/Image/aligned/train_{row:05d}_aligned.jpg" for row in range(1, 9))),
    **images("basic/Image/aligned/test_0001_aligned.jpg", "basic/Image/original/train_00001.jpg"),
    "compound/EmoLabel/list_patition_label.txt": "train_0001.jpg 11\n",
}
IDS = [f"{row:031x}a" for row in range(6)] + ["1c9725db9005eda1aaa354fd606bff0"]
CAR_PARTS = ("train", "train", "train", "val", "val", "test", "test")
CARS = images(*(f"{part}/{name}_0.png" for part, name in zip(CAR_PARTS, IDS, strict=True)))
SHAPENET = {
    "metadata.csv": "fullId,wnsynset,wnlemmas,up,front,name,tags\n"
    f'3dw.{IDS[0]},n1,"cruiser,police cruiser,patrol car,police car",,,Crown Victoria,\n'
    f'3dw.{IDS[1]},n2,"ambulance",,,"Krankenwagen, weiss","ambulance,red cross"\n'
    f'3dw.{IDS[2]},n3,"car,auto",,,Lincoln Town Car LIMO,"long"\n'
    f'3dw.{IDS[3]},n4,"jeep,landrover",,,Wrangler,\n'
    f'3dw.{IDS[4]},n5,"sports car,sport car",,,Ferrari 458,italy\n'
    f'3dw.{IDS[6]},n6,"car,auto",,,Jeepney of Manila,"bus"\n'
}
BUFFY = "CVHCI_TRACKLABELS_V1\n1 giles\n13 buffy\n52 unknown_e02_8\n"
EPISODES = {
    "ids/buffy.ids": BUFFY,
    "ids/bbt.ids": "CVHCI_TRACKLABELS_V1\n1 penny\n2 sheldon\n",
    **images("bbt/00001/a b.jpg", "notes/x.jpg"),
    **images(*(f"buffy/{at}.jpg" for at in ("1/0001", "13/0002", "99/0001"))),
}
NESTED = images("Ann/0/0.555.jpg", "Ann/1/0.1.jpg", "Bo/0/0.3.jpg", "Bo/track_002/frame_01.jpg")
LISTED = (
    "path,age,kind,smiles,split,id\n"
    'a b/1.png,31,cat,yes,train,007\nünï/2.png,,"dog, big",,val,12\n"new\nline.png",4.5,,no,test,9\n'
)
TABLE = {**images("a b/1.png", "ünï/2.png", "new\nline.png", "other.png"), "data.csv": LISTED}

TREES = {
    "utkface": UTKFACE, "lfw": LFW, "yaleb": YALE, "celeba": {**ALIGNED, **ATTRIBUTES},
    "celebamask": images("images/0.jpg", "images/1.jpg", "masks/0.png", "masks/1.png"),
    "synface": SYNFACE, "syncar": SYNCAR, "synface_tracks": TRACKS, "rafdb": RAF,
    "depth_pairs": images("train/image/1.png", "train/depth/1.png", "test/image/1.png", "test/depth/1.png"),
    "shapenet_cars": {f"02958343/{file}": None for file in CARS}, "face_tracks": EPISODES,
    "table": TABLE, "classes": images("cats/1.png", "cats/2.png", "dogs/1.png"),
    "folder": images("1.png", "a/2.png", "b/c/3.png"),
}  # fmt: skip


def as_parquet() -> bytes:
    """The table of ``LISTED``, with its ages as numbers."""
    stored = BytesIO()
    columns = {
        "path": ["a b/1.png", "ünï/2.png", "new\nline.png"], "age": [31, None, 4.5],
        "kind": ["cat", "dog, big", None], "smiles": ["yes", None, "no"],
        "split": ["train", "val", "test"], "id": ["007", "12", "9"],
    }  # fmt: skip
    pq.write_table(pa.table(columns), stored)
    return stored.getvalue()


def found_in(source, **options):
    with list_images(source, **options) as result:
        return result


PLAIN = [  # nothing more particular
    ("classes", images("cats/siamese/1.jpg", "dogs/pug/2.jpg")),
    ("classes", images("train/0/1.png", "train/1/2.png", "test/0/3.png")),
    ("folder", images("train/1.png", "test/2.png")),
    ("folder", images("cat/1.png", "dog/2.png", "3.png")),
    ("folder", images("only/1.png", "only/2.png")),
    ("classes", images("one/0/1.png", "one/1/2.png")),
    ("folder", images(*(f"{name}.png" for name in IDS))),  # scraped images are named by a checksum
    ("folder", {"metadata.csv": "camera,lens\nx,y\n", "1.png": None}),
]


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize(("name", "files"), [*((one.name, TREES[one.name]) for one in LAYOUTS), *PLAIN])
def test_recognised_wherever_the_tree_lies(tree, name, files, zipped, wrapped):
    """As published, and inside a folder that an archive program added."""
    around = "download/" if wrapped else ""
    result = found_in(tree({around + file: content for file, content in files.items()}, zipped))
    assert result.layout == name
    for column in result.table.labels.values():
        assert len(column) == len(result.table.files) > 0


RADIANS = {"light_pitch_rad": [pi / 6, 0], "light_yaw_rad": [-pi / 4, 0]}
RADIANS |= {f"camera_{axis}_rad": [pi / part, 0] for axis, part in (("x", 18), ("y", 9), ("z", 36))}
OLD = images(*(f"{name}_20170116184028385.jpg" for name in ("116_3_4", "117_0_0", "53__0", "7_1_5")))
YOUNG = images(*(f"{age}_0_2_{CHIP}" for age in range(10, 30)), "stray.jpg")
KNOWN = {  # files, how they are read; labels, and partition
    "utkface": (UTKFACE, {}, {"age": [100, 24, 39, 55], "gender": ["female", "male", "female", "male"],
        "race": ["white", "black", "", ""]}, None),
    "utkface codes": (OLD, {}, {"age": [116, nan, 53, 7], "gender": ["", "male", "", "female"],
        "race": ["other", "white", "white", ""]}, None),
    "utkface stray": (YOUNG, {}, {"age": [*range(10, 30), nan]}, None),
    "lfw": (LFW, {}, {"identity": ["Ann_Lee", "Bo", "Cy_X"]}, None),
    "yaleb": ({**YALE, "yaleB02_P00_Ambient.pgm": None}, {"dataset": "yaleb"}, {"identity": ["yaleB02"] * 3,
        "light_azimuth_deg": [0, 120, -50], "light_elevation_deg": [0, -20, 0],
        "light_deg": [0, 118.024, 50]}, None),
    "lfw emotions": ({**LFW, "emotions.csv": "file,emotion\nBo_0001.jpg,happiness\n"}, {}, {"emotion": ["",
        "happiness", ""]}, None),
    "lfw view 1": ({**LFW, **VIEW_1, "pairs.txt": "10\t300\n"}, {}, {}, ["train", "test", ""]),
    "lfw part": ({**LFW, **VIEW_1}, {"subset": "test"}, {"identity": ["Bo"]}, ["test"]),
    "celeba": ({**ALIGNED, **ATTRIBUTES}, {}, {"Bald": [0, 1, -1], "Smiling": [1, 0, -1]}, None),
    "celeba lists": ({**ALIGNED, **ATTRIBUTES, **PARTITION, "identity_CelebA.txt": "000001.jpg 2880\n"}, {},
        {"identity": ["2880", "", ""]}, ["train", "validation", "test"]),
    "celeba part": ({**ALIGNED, **ATTRIBUTES, **PARTITION}, {"subset": "val"}, {"Bald": [1]}, ["validation"]),
    "celeba csv": ({"a/img_align_celeba/000001.jpg": None,
        "list_attr_celeba.csv": "image_id,Bald\n000001.jpg,1\n",
        "list_eval_partition.csv": "image_id,partition\n000001.jpg,2\n"}, {}, {"Bald": [1]}, ["test"]),
    "celeba both": ({**WILD, **ALIGNED}, {}, {"Bald": [0, 1, -1]}, None),
    "synface": (SYNFACE, {}, {"identity": ["7", "8"], "expression": ["happy", "sad"], "strength": [0.5, nan],
        "ambient": [0.3, 0.3], "camera_tx": [0.001, 0], **RADIANS}, ["train", "train"]),
    "synface subset": (SYNFACE, {"subset": "test_gt"}, {"identity": ["9"]}, ["test_gt"]),
    "synface no row": ({**SYNFACE, "train/images/000002.jpg": None}, {}, {"identity": ["7", "8", ""],
        "ambient": [0.3, 0.3, nan]}, ["train"] * 3),
    "synface pandas": ({**SYNFACE,
        "train/params.csv": ',file,expression\n0,images/000000.jpg,"two\nlines"\n'}, {},
        {"expression": ["two\nlines", ""]}, ["train"] * 2),
    "syncar": (SYNCAR, {}, {"class": ["taxi"], "model": ["a/b"], "elevation_rad": [pi / 2]}, ["train"]),
    "tracks": ({**TRACKS, "params.csv": PARAMS + FIRST.replace("images/000000", "tracks/id1/track_000/000")},
        {}, {"identity": ["id1", "id1", "id2"], "track": ["id1/track_000", "id1/track_001", "id2/track_000"],
        "expression": ["happy", "", ""]}, None),
    "rafdb": (RAF, {"subset": "train"}, {"emotion": [*EMOTIONS, ""]}, ["train"] * 8),
    "rafdb spelt right": ({"list_partition_label.txt": "test_1.jpg 1\n", "a/test_1_aligned.jpg": None}, {},
        {"emotion": ["surprise"]}, ["test"]),
    "cars": ({**CARS, **SHAPENET}, {"subset": "train"}, {"model": IDS[:3], "class": list(CAR_CLASSES)[:3]},
        ["train"] * 3),
    "cars val": ({**CARS, **SHAPENET}, {"subset": "val"}, {"name": ["Wrangler", "Ferrari 458"],
        "class": list(CAR_CLASSES)[3:]}, ["validation"] * 2),
    "cars other": ({**CARS, **SHAPENET}, {"subset": "test"}, {"class": ["", ""]}, ["test"] * 2),
    "cars by ids": (images(*(f"{name}.png" for name in IDS)), {"dataset": "shapenet_cars"}, {"model": IDS},
        None),
    "cars by parts": (images("test/images/1.png", "test/depth/1.png", "train/0.png"),
        {"dataset": "shapenet_cars"}, {}, ["test", "train"]),
    "episodes": (EPISODES, {}, {"identity": ["penny", "giles", "buffy", "", ""], "track": ["bbt/1", "buffy/1",
        "buffy/13", "buffy/99", ""], "episode": ["bbt", "buffy", "buffy", "buffy", ""], "frame": ["a b",
        "0001", "0002", "0001", "x"]}, None),
    "one episode": (EPISODES, {"subset": "bbt"}, {"identity": ["penny"]}, None),
    "one list": ({"buffy.ids": BUFFY, "faces/0013/1.jpg": None, "faces/0052/1.jpg": None}, {},
        {"identity": ["buffy", "unknown_e02_8"], "track": ["buffy/13", "buffy/52"]}, None),
    "nested": (NESTED, {}, {"identity": ["Ann", "Ann", "Bo", "Bo"], "frame": ["0.555", "0.1", "0.3",
        "frame_01"], "track": ["Ann/0", "Ann/1", "Bo/0", "Bo/track_002"]}, None),
    "unnumbered": (images("Ann/kitchen/x.jpg", "Bo/bar/y.jpg"), {"dataset": "face_tracks"},
        {"track": ["Ann/kitchen", "Bo/bar"]}, None),
    "csv": (TABLE, {}, {"age": [31, nan, 4.5], "kind": ["cat", "dog, big", ""], "smiles": [1, -1, 0],
        "id": ["007", "12", "9"]}, ["train", "validation", "test"]),
    "parquet": ({**images("a b/1.png", "ünï/2.png", "new\nline.png"), "data.parquet": as_parquet()}, {},
        {"age": [31, nan, 4.5], "smiles": [1, -1, 0], "id": ["007", "12", "9"]}, ["train", "validation",
        "test"]),
    "own split": ({"a/metadata.csv": "file_name,x,split\n1.png,3,one\n./2.png,4,two\n", **images("a/1.png",
        "a/2.png")}, {}, {"x": [3, 4], "split": ["one", "two"]}, None),
    "a table first": ({"data.csv": f"file,mood\n24_0_1_{CHIP},good\n", f"24_0_1_{CHIP}": None}, {},
        {"mood": ["good"]}, None),
    "classes in parts": (images("test/cat/2.png", "train/cat/1.png", "train/dog/1.png", "val/dog/4.png"), {},
        {"class": ["cat", "cat", "dog", "dog"]}, ["test", "train", "train", "validation"]),
    "parts": (images("3.png", "Train/1.png", "test/2.png"), {}, {}, ["", "train", "test"]),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_labels_and_parts_are_those_published(tree, name):
    files, options, labels, partition = KNOWN[name]
    table = found_in(tree(files), **options).table
    for column, values in labels.items():
        if isinstance(values[0], str):
            assert table.labels[column].tolist() == values, column
        else:
            np.testing.assert_allclose(table.labels[column], values, rtol=1e-6, err_msg=column)
            assert table.labels[column].dtype in (np.float32, np.int8)
    assert (None if table.partition is None else table.partition.tolist()) == partition


def test_sub_folders_separators_and_names_that_overrule(tree):
    source = tree(["a/1.png", "a/b/2.png", "c/3.png"])
    assert found_in(f"{source}::a").table.files == ("a/1.png", "a/b/2.png")
    assert found_in(source, subset="b").table.files == ("a/b/2.png",)
    assert found_in(tree(["1.png"], name="odd::name")).table.files == ("1.png",)
    overruled = found_in(tree(TREES["classes"], name="classes"), dataset="folder")
    assert (overruled.layout, overruled.table.labels) == ("folder", {})
    one = found_in(tree(SYNFACE, name="rendered") / "test_gt").table
    assert (one.files, one.partition) == (("images/000000.jpg",), None)


ROW = "images/000000.jpg"
TRAIN = "train/params.csv"
AS = {"dataset": "table"}
LIST_OF_RAF = "basic/EmoLabel/list_patition_label.txt"
FAULTS = [
    ({**ALIGNED, "list_attr_celeba.txt": "2\nBald Smiling\n000001.jpg -1 1\n000002.jpg 1\n"}, {},
     r"list_attr_celeba\.txt in .*line 4: expected a name and 2 values of -1 or 1"),
    ({**ALIGNED, "list_attr_celeba.txt": "3\nBald\n000001.jpg -1\n"}, {}, "says 3 rows and it has 1; copy"),
    (ALIGNED, {"dataset": "celeba"}, r"CelebA: .* expected list_attr_celeba\.txt .* owners publish it at h"),
    (WILD, {}, r"no list_landmarks_celeba\.txt, .* owners publish it at h"),
    ({**ATTRIBUTES, "img_align_celeba.zip": "x"}, {}, r"list_attr_celeba\.txt and img_align_celeba"),
    ({**WILD, **MARKED, "list_eval_partition.txt": "000001.jpg 3\n"}, {}, r"line 1: .* of 0 \(train\), .*"),
    ({**WILD, "list_landmarks_celeba.txt": LANDMARKS.replace("lefteye_x", "x")}, {}, "no column 'lefteye"),
    ({**WILD, "boxes.csv": SIZED}, {}, r"boxes\.csv .* no row for 000003\.jpg \(1 of 3 images have none"),
    ({**WILD, "boxes.csv": SIZED + "000003.jpg,1,2,3\n"}, {}, "line 4: expected 5 values as in the header"),
    ({**WILD, "boxes.csv": SIZED + "000003.jpg,1,2,3,x\n"}, {}, "something that is no number .*'x'"),
    ({**WILD, "boxes.csv": SIZED + "000003.jpg,1,2,nan,4\n"}, {}, r"the box of 000003\.jpg has no area"),
    ({**WILD, "boxes.csv": SIZED.replace("width", "w")}, {}, "no column 'right'; its columns are file,"),
    ({**SYNFACE, TRAIN: PARAMS.replace("file", "name")}, {"dataset": "synface"}, "no column 'file'; its"),
    ({**SYNFACE, TRAIN: f"{PARAMS}{ROW}{',x' * 12}\n"}, {}, "column 'strength' holds something that is no"),
    ({**SYNFACE, TRAIN: PARAMS + "x" * 200_000}, {}, "is no CSV table"),
    ({**SYNFACE, TRAIN: f"{PARAMS}images/x.jpg{',0' * 12}\n"}, {}, "names none of the images beside it"),
    ({**TRACKS, "stray.jpg": None}, {"dataset": "synface_tracks"}, "every image in tracks/"),
    (images("1.png"), {"dataset": "lfw"}, "cannot be read as lfw .* folder of a person; its"),
    ({**LFW, "peopleDevTest.txt": "3\nBo\t1\n"}, {}, r"peopleDevTest\.txt in .* is cut short: 1 people of 3"),
    ({**RAF, LIST_OF_RAF: "a.jpg 5\nb.jpg 8\n"}, {}, r"line 2: expected an image and an emotion from 1"),
    ({**RAF, LIST_OF_RAF: "other.jpg 5\n"}, {}, "names none of its images; the first is"),
    ({LIST_OF_RAF: "a.jpg 5\n", "basic/aligned.zip": "x"}, {}, r"Image/aligned/train_00001_aligned\.jpg"),
    (images("a/test_1_aligned.jpg"), {"dataset": "rafdb"}, r"expected EmoLabel/list_patition_label\.txt"),
    (images("1.png"), {"dataset": "shapenet_cars"}, "ShapeNet cars, .* expected folders train,"),
    ({**CARS, "metadata.csv": "fullId,wnlemmas,name,tags\n3dw.ffff,,x,y\n"}, {}, "names none of the models"),
    (images("a/1.jpg"), {"dataset": "face_tracks"}, r"NAME\.ids .* or every image in IDENTITY/TRACK/"),
    ({**EPISODES, "ids/buffy.ids": "1 giles\n"}, {}, r"buffy\.ids in .*, line 1: expected a first line"),
    ({**EPISODES, "ids/buffy.ids": BUFFY + "13 dawn\n"}, {}, "line 5: track 13 has two names"),
    ({"x.ids": BUFFY, "77/1.jpg": None}, {}, r"expected NAME\.ids with some image in NAME/N"),
    ({"data.csv": "name,x\n1.png,2\n", "1.png": None}, AS, r"no column of paths \(file, path, .*columns"),
    ({"data.csv": "file;x\n1.png;2\n", "1.png": None}, {}, r"its columns are file;x"),
    ({"data.csv": "File,x\n7.png,1\n", "1.png": None}, {}, r"'File' of data\.csv .* no image"),
    ({"data.csv": "file\n../1.png\n", "1.png": None}, AS, r"row 1: .* relative to the table .* got"),
    ({"data.csv": "file\nC:\\1.png\n", "1.png": None}, AS, "row 1: expected a path relative"),
    ({"data.csv": "file\n1.png\n./1.png\n", "1.png": None}, AS, r"row 2: '1\.png' is there twice"),
    ({"data.csv": "file,x\n1.png\n", "1.png": None}, AS, "line 2: expected 2 values as in the header"),
    ({"data.csv": "file\n7.png\n", "1.png": None}, AS, r"'file' of data\.csv .* no image .*: the first is"),
    ({"data.parquet": b"PAR1", "1.png": None}, {}, r"data\.parquet in .* is no Parquet table"),
    (images("1.png"), AS, r"table of its images: data\.csv"),
    (images("a/1.png", "c/3.png"), {"subset": "d"}, "no part 'd': its parts are none, its folders a, c"),
    (images("1.png"), {"dataset": "utkfaces"}, r"unknown data set 'utkfaces'; did you mean 'utkface'\?"),
    (images("1.png"), {"dataset": "utkface"}, r"UTKFace: .* images named \[age\]_\[gender\]"),
    (images("1.png"), {"dataset": "synface"}, r"expected params\.csv with images"),
    ({"a.txt": "x", "b.txt": "x", "c.psd": "x", "faces.zip": "x"}, {}, r"no images found in .*: looked"),
]  # fmt: skip


@pytest.mark.parametrize(("files", "options", "message"), FAULTS, ids=[message for *_, message in FAULTS])
def test_faults_are_named(tree, files, options, message):
    with pytest.raises(ValueError, match=message):
        list_images(tree(files), **options)


def test_faults_of_addresses_archives_and_nested_columns(tree, tmp_path, encoded):
    with pytest.raises(ValueError, match="names the part 'train', but subset='test_gt' was given too"):
        list_images(f"{tree(SYNFACE)}::train", subset="test_gt")
    with pytest.raises(ValueError, match=r"passed over 1, the first is '\.\./1\.png': unsafe name"):
        list_images(tree(["../1.png"], zipped=True))
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", tree([], zipped=True, name="nothing")):
        with pytest.raises(ValueError, match=r"no images found in .*found no files at all"):
            list_images(source)
    stored = BytesIO()
    pq.write_table(pa.table({"image": [{"bytes": encoded(1), "path": "1.png"}]}), stored)
    nested = tree({"data.parquet": stored.getvalue(), "1.png": None}, name="nested")
    with pytest.raises(ValueError, match=r"column 'image' of data\.parquet .* struct<.*kept inside a table"):
        list_images(nested)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["True", "no", "NO", ""], np.array([1, 0, 0, -1], np.int8)),
        (["1", "0", "2"], np.array([1, 0, 2], np.float32)),
        (["-1", "1.5e3", ""], np.array([-1, 1500, nan], np.float32)),
        (["01", "2"], np.array(["01", "2"])), (["16777217", "2"], np.array(["16777217", "2"])),
        (["16777216", "2"], np.array([16777216, 2], np.float32)), (["1", "inf"], np.array(["1", "inf"])),
        ([" x ", "1"], np.array(["x", "1"])), (["", ""], np.array(["", ""])),
    ],
)  # fmt: skip
def test_what_a_column_is(cells, expected):
    result = label_column(cells)
    assert result.dtype.kind == expected.dtype.kind and result.itemsize >= expected.itemsize
    np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize(("name", "content"), [("mine.csv", LISTED), ("mine.PARQUET", as_parquet())])
def test_a_table_given_by_name(tree, name, content, tmp_path):
    files = [file for file in TABLE if file != "data.csv"]
    folder = tree({**images(*files), name: content, "gone.csv": "file\nother.png\nx.png\nnotes.txt\n"})
    pictures = read_images(folder / name, 8)
    assert (pictures.layout, pictures.files) == ("table", tuple(files[:3]))
    assert (pictures.images == read_images(folder, 8, dataset="folder").select([0, 3, 1]).images).all()
    cached = [read_images(folder / name, 8, cache=tmp_path / "cache").images for _ in range(2)]
    assert (cached[1] == pictures.images).all()
    assert read_images(f"{folder / name}::validation", 8).files == ("ünï/2.png",)
    assert read_images(folder / name, 8, subset="a b").files == ("a b/1.png",)
    partly = read_images(folder / "gone.csv", 8)
    assert partly.files == ("other.png",) and [row.file for row in partly.skipped] == ["x.png", "notes.txt"]


def test_cars_of_the_published_size_are_cropped(tree, encoded):
    contents = {file: encoded(noise(row, 128, 128)) for row, file in enumerate(CARS)}
    pictures = read_images(tree({**contents, **SHAPENET}), 25)
    crop = np.array([14, 8, 114, 108], np.float32)
    for file, image in zip(pictures.files, pictures.images, strict=True):
        assert (image == decode(contents[file], 25, "crop", crop)).all()
    assert found_in(tree({**CARS, **SHAPENET}, name="small")).table.boxes is None


def test_celeba_in_the_wild_is_cropped_by_landmarks(tree, encoded, tmp_path):
    """Eyes' middle (25, 30), 10 apart; mouth's 10 below: side max(40, 36), middle 1 above the eyes."""
    contents = {file: encoded(noise(row, 60, 50)) for row, file in enumerate(WILD) if file.endswith("jpg")}
    source, sides = tree({**WILD, **contents, **MARKED, **PARTITION}), ([5, 9, 45, 49], [4, 11, 40, 47])
    boxes = found_in(source).table.boxes
    np.testing.assert_allclose(boxes[:2], sides)
    assert np.isnan(boxes[2]).all()
    assert found_in(source, subset="val").table.boxes.tolist() == [sides[1]]
    pairs = zip(list(contents.values())[:2], sides, strict=True)
    expected = [decode(content, 10, "crop", np.array(box, np.float32)) for content, box in pairs]
    for options in ({}, {"cache": tmp_path / "cache"}, {"cache": tmp_path / "cache"}):
        pictures = read_images(source, 10, **options)
        assert [row.file for row in pictures.skipped] == ["img_celeba/000003.jpg"]
        assert "no usable box is known" in pictures.skipped[0].reason
        assert (pictures.images == np.stack(expected)).all()
    tree({"list_landmarks_celeba.txt": LANDMARKS.replace("20 30 30 30", "22 30 32 30")})
    moved, same = read_images(source, 10, cache=tmp_path / "cache").images[:2]
    assert (moved != expected[0]).any() and (same == expected[1]).all()
    for own, last in ((SIZED + "000003.jpg,-5,-4,30,30\n", [-5, -4, 25, 26]), (SIDES, [0, 0, 40, 30])):
        boxes = [[2, 3, 22, 33], [5, 1, 25, 21], last]  # of a list of one's own, which may stick out a little
        assert found_in(tree({"boxes.csv": own})).table.boxes.tolist() == boxes
        pairs = zip(contents.values(), boxes, strict=True)
        cut = [decode(content, 10, "crop", np.array(box, np.float32)) for content, box in pairs]
        assert (read_images(source, 10).images == np.stack(cut)).all()


def test_a_half_is_by_person_and_the_same_in_every_set(tree):
    people = [f"P{row}/P{row}_{shot:04d}.jpg" for row in range(40) for shot in (1, 2)]
    halves = [found_in(f"{tree(images(*people))}?half={half}").table for half in ("development", "test")]
    first, second = (set(half.labels["identity"].tolist()) for half in halves)
    assert not first & second and len(first | second) == 40 and min(len(first), len(second)) >= 12
    some = found_in(f"{tree(images(*people[::3]), True)}?half=test").table
    assert set(some.labels["identity"].tolist()) <= second
    with pytest.raises(ValueError, match="unknown half 'tst'; did you mean 'test'"):
        found_in(f"{tree(images(*people))}?half=tst")
