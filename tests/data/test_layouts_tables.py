"""Paths and labels from CSV and Parquet: beside pictures in folders and zips, and given by name."""

import io
import math

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from derender.data import list_images, read_pictures
from derender.data.layouts.tables import label_column

ROWS = [
    {"path": "a b/1.png", "age": "31", "kind": "cat", "smiles": "yes", "split": "train", "id": "007"},
    {"path": "ünï/2.png", "age": "", "kind": "dog, big", "smiles": "", "split": "val", "id": "12"},
    {"path": "new\nline.png", "age": "4.5", "kind": "", "smiles": "no", "split": "test", "id": "9"},
]
PICTURES = dict.fromkeys(row["path"] for row in ROWS)


def as_csv(rows=ROWS) -> str:
    lines = [",".join(rows[0]), *(",".join(f'"{cell}"' for cell in row.values()) for row in rows)]
    return "\n".join(lines) + "\n"


def as_parquet(rows=ROWS) -> bytes:
    stored = io.BytesIO()
    numbers = [float(row["age"]) if row["age"] else None for row in rows]
    columns = {name: [row[name] or None for row in rows] for name in rows[0]}
    pq.write_table(pa.table({**columns, "age": numbers}), stored)
    return stored.getvalue()


def inventory_of(source, **options):
    inventory = list_images(source, **options)
    inventory.files.close()
    return inventory


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize(("name", "content"), [("data.csv", as_csv()), ("data.parquet", as_parquet())])
def test_beside_the_pictures(tree, zipped, name, content):
    inventory = inventory_of(tree({**PICTURES, name: content, "other.png": None}, zipped))
    assert inventory.layout == "table"
    found = inventory.table
    assert found.files == tuple(PICTURES)
    assert found.labels["age"].tolist()[::2] == [31, 4.5] and np.isnan(found.labels["age"][1])
    assert found.labels["kind"].tolist() == ["cat", "dog, big", ""]
    assert found.labels["smiles"].tolist() == [1, -1, 0]
    assert found.labels["id"].tolist() == ["007", "12", "9"]
    assert found.partition.tolist() == ["train", "validation", "test"]


@pytest.mark.parametrize(("name", "content"), [("mine.csv", as_csv()), ("mine.PARQUET", as_parquet())])
def test_given_by_name(tree, name, content, tmp_path):
    folder = tree({**PICTURES, name: content, "other.png": None})
    pictures = read_pictures(folder / name, 8)
    assert (pictures.layout, pictures.files) == ("table", tuple(PICTURES))
    assert (pictures.images == read_pictures(folder, 8, dataset="folder").select([0, 3, 1]).images).all()
    cached = [read_pictures(folder / name, 8, cache=tmp_path / "cache").images for _ in range(2)]
    assert (cached[1] == pictures.images).all()
    assert read_pictures(f"{folder / name}::validation", 8).files == ("ünï/2.png",)
    assert read_pictures(folder / name, 8, subset="a b").files == ("a b/1.png",)


def test_paths_are_relative_to_the_table(tree):
    text = "file_name,x\n1.png,3\n./2.png,4\n"
    found = inventory_of(tree({"train/metadata.csv": text, "train/1.png": None, "train/2.png": None})).table
    assert found.files == ("train/1.png", "train/2.png")


def test_rows_without_a_picture_are_listed(tree):
    text = "file,x\n1.png,3\ngone.png,4\nnotes.txt,5\n"
    folder = tree({"data.csv": text, "1.png": None, "notes.txt": "x"})
    for source in (folder, folder / "data.csv"):
        pictures = read_pictures(source, 8)
        assert pictures.files == ("1.png",)
        assert [(row.file, row.reason) for row in pictures.skipped] == [
            (file, "named in data.csv, but no image of that name is there")
            for file in ("gone.png", "notes.txt")
        ]


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["1", "0", ""], np.array([1, 0, -1], np.int8)),
        (["True", "no", "NO"], np.array([1, 0, 0], np.int8)),
        (["1", "0", "2"], np.array([1, 0, 2], np.float32)),
        (["-1", "1.5e3", ""], np.array([-1, 1500, math.nan], np.float32)),
        (["-1", "1"], np.array([-1, 1], np.float32)),
        (["01", "2"], np.array(["01", "2"])),
        (["16777217", "2"], np.array(["16777217", "2"])),
        (["16777216", "2"], np.array([16777216, 2], np.float32)),
        (["1", "inf"], np.array(["1", "inf"])),
        ([" x ", "1"], np.array(["x", "1"])),
        (["", ""], np.array(["", ""])),
    ],
)
def test_what_a_column_is(cells, expected):
    found = label_column(cells)
    assert found.dtype.kind == expected.dtype.kind and found.itemsize >= expected.itemsize
    np.testing.assert_array_equal(found, expected)


def test_a_split_of_ones_own_is_a_label(tree):
    found = inventory_of(
        tree({"data.csv": "file,split\n1.png,fold1\n2.png,train\n", "1.png": None, "2.png": None})
    ).table
    assert found.partition is None
    assert found.labels["split"].tolist() == ["fold1", "train"]


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "name,x\n1.png,2\n",
            r"data\.csv in .* has no column of paths \(file, path, image, .*columns are name, x",
        ),
        ("", "has no column of paths"),
        (
            "file,x\n../1.png,2\n",
            r"row 1: expected a path relative to the table and below it, got '\.\./1\.png'",
        ),
        ("file,x\na/../../1.png,2\n", "row 1: expected a path relative"),
        (
            "file,x\n1.png,2\n/etc/passwd,2\n",
            "row 2: expected a path relative to the table and below it, got '/etc",
        ),
        ("file,x\nC:\\1.png,2\n", "row 1: expected a path relative"),
        ("file,x\n,2\n", "row 1: expected a path relative"),
        ("file,x\n1.png,2\n./1.png,3\n", r"row 2: '1\.png' is there twice"),
        ("file,x\n1.png\n", "line 2: expected 2 values as in the header"),
        (
            "file,x\n7.png,2\n",
            r"the column 'file' of data\.csv in .* names no image .*: the first is '7\.png'",
        ),
        ("file,x\n", "names no image that is there; paths are relative"),
    ],
)
def test_faults_are_named(tree, zipped, text, message):
    with pytest.raises(ValueError, match=message):
        list_images(tree({"data.csv": text, "1.png": None}, zipped), dataset="table")


def test_faults_of_parquet_are_named(tree, encoded):
    stored = io.BytesIO()
    pq.write_table(pa.table({"image": [{"bytes": encoded(1), "path": "1.png"}]}), stored)
    with pytest.raises(
        ValueError, match=r"column 'image' of data\.parquet in .* holds struct<.*kept inside a table"
    ):
        list_images(tree({"data.parquet": stored.getvalue(), "1.png": None}))
    with pytest.raises(ValueError, match=r"data\.parquet in .* is no Parquet table"):
        list_images(tree({"data.parquet": b"PAR1", "1.png": None}, name="cut"))
    with pytest.raises(ValueError, match=r"has no table of its images: expected data\.csv"):
        list_images(tree(["1.png"], name="none"), dataset="table")


def test_a_metadata_table_about_something_else_is_passed_over(tree):
    assert inventory_of(tree({"metadata.csv": "camera,lens\nx,y\n", "1.png": None})).layout == "folder"


def test_a_table_comes_before_what_names_look_like(tree):
    name = "24_0_1_20170116220224657.jpg"
    assert inventory_of(tree({"data.csv": f"file,mood\n{name},good\n", name: None})).layout == "table"
