"""FeatureTable: what goes in comes out, from a model, memory and the file; wrong tables cannot exist."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from tests.features.conftest import assert_same

from derender.features import FeatureTable, embed_image_set, missing, model_fingerprint


def make(rows: int = 5, **labels) -> FeatureTable:
    rng = np.random.default_rng(0)
    factors = {"geometry": rng.normal(size=(rows, 4)), "albedo": rng.normal(size=(rows, 3))}
    origin = {"model": "runs/faces", "nested": {"preset": "small", "π": [1, 2]}}
    return FeatureTable(tuple(f"{i}.jpg" for i in range(rows)), factors, labels, origin)


def test_round_trip_keeps_values_names_order_kinds_and_missing_labels(tmp_path):
    table = FeatureTable(
        ("a b.jpg", "Łódź/Søren.jpg", "人/一.png", "new\nline.png", ""),
        {"Geometrie é": np.arange(20).reshape(5, 4), "albedo": np.zeros((5, 1))},
        {
            "identity": np.array(["Zoë", "", "李", "a", "b"]),
            "emotion": np.array(["happy", None, "sad", None, "sad"], dtype=object),
            "age": np.array([1.5, np.nan, 3, 4, 5], np.float32),
            "count": np.array([1, None, 3, 4, 5], dtype=object),
            "smiling": np.array([1, 0, -1, 1, 0], np.int8),
            "track": np.arange(5),
            "seen": np.array([True, False, True, True, False]),
        },
        {"modèle": "x"},
    )
    back = FeatureTable.read(table.write(tmp_path / "new folder" / "täble.parquet"))
    assert_same(back, table)
    assert back.labels["smiling"].dtype == np.int8
    assert back.labels["age"].dtype == np.float32


def test_other_tools_see_plain_columns_and_json(tmp_path):
    path = make(identity=np.array(list("aabbc"))).write(tmp_path / "t.parquet")
    table = pq.read_table(path)
    assert table.column_names == ["file", "geometry", "albedo", "identity"]
    assert table.schema.field("geometry").type.value_type == pa.float32()
    described = json.loads(table.schema.metadata[b"derender"])
    assert described["factors"] == ["geometry", "albedo"] and described["origin"]["nested"]["π"] == [1, 2]


def test_a_failed_write_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch):
    path = make().write(tmp_path / "t.parquet")
    before = path.read_bytes()
    with pytest.raises(ValueError, match="label 'mixed' mixes kinds"):
        make(mixed=np.array([1, "a", 2.5, [3], None], dtype=object)).write(path)
    with pytest.raises(TypeError):
        FeatureTable(("a",), {"f": np.ones((1, 1))}, origin={"x": object()}).write(path)

    def dies(writer, table):
        raise OSError("no space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", dies)
    with pytest.raises(OSError, match="no space left"):
        make(3).write(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["t.parquet"]


def test_files_made_elsewhere_list_columns_are_factors(tmp_path):
    columns = {"code": [[1.0, 2.0], [3.0, 4.0]], "file": ["a", "b"], "who": ["x", None], "wide": [[1], [2]]}
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    back = FeatureTable.read(tmp_path / "t.parquet")
    assert list(back.factors) == ["code", "wide"] and list(back.labels) == ["who"]
    np.testing.assert_array_equal(back.concatenate(), [[1, 2, 1], [3, 4, 2]])
    assert missing(back.label("who")).tolist() == [False, True]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"f": [[1.0]]}, "no column 'file'"),
        ({"file": ["a"], "x": [1]}, "no column of lists"),
        ({"file": ["a", "b"], "f": [[1.0], [1.0, 2.0]]}, "rows of different lengths \\(1 to 2\\)"),
        ({"file": ["a", "b"], "f": [[1.0], None]}, "empty in 1 rows"),
        ({"file": ["a"], "f": [["x"]]}, "holds string, expected numbers"),
        ({"file": ["a", "b"], "f": [[1.0], [np.nan]]}, "t.parquet: factor 'f' is not finite in 1 of 2 rows"),
        ({"file": ["a", "b"], "f": [[1.0, None], [1.0, 2.0]]}, "not finite in 1 of 2 rows"),
    ],
)
def test_wrong_files_are_refused_in_words(tmp_path, columns, message):
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    with pytest.raises(ValueError, match=message):
        FeatureTable.read(tmp_path / "t.parquet")


def test_absent_and_damaged_files_are_refused_in_words(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no feature table at .*nowhere.parquet: make one with"):
        FeatureTable.read(tmp_path / "nowhere.parquet")
    (tmp_path / "text.parquet").write_text("hello")
    with pytest.raises(ValueError, match=r"text.parquet is not a readable parquet file"):
        FeatureTable.read(tmp_path / "text.parquet")
    whole = make().write(tmp_path / "t.parquet").read_bytes()
    (tmp_path / "cut.parquet").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut.parquet is not a readable parquet file"):
        FeatureTable.read(tmp_path / "cut.parquet")
    with pytest.raises(ValueError, match="is a folder"):
        make().write(tmp_path)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (b"{", r"metadata of .* is damaged"),
        (b'{"factors": []}', r"metadata of .* is damaged"),
        (b'{"format": 99}', "has format 99, this version reads up to 1"),
        (b'{"format": 1, "factors": ["gone"], "labels": []}', "lacks the column 'gone'"),
        (b'{"format": 1, "factors": ["who"], "labels": []}', "factor 'who' is a column of string"),
    ],
)
def test_damaged_metadata_is_refused_in_words(tmp_path, metadata, message):
    table = pa.table({"file": ["a"], "f": [[1.0]], "who": ["x"]})
    pq.write_table(table.replace_schema_metadata({b"derender": metadata}), tmp_path / "t.parquet")
    with pytest.raises(ValueError, match=message):
        FeatureTable.read(tmp_path / "t.parquet")


@pytest.mark.parametrize(
    ("files", "factors", "labels", "message"),
    [
        ("ab", {"f": np.ones((3, 2))}, {}, "factor 'f' has 3 rows, but there are 2 files"),
        ("ab", {"f": np.ones((2, 2))}, {"who": np.ones(3)}, "label 'who' has 3 rows, but there are 2 files"),
        ("ab", {"f": np.ones(2)}, {}, "factor 'f' must have at least one number in each row"),
        ("ab", {"f": np.ones((2, 0))}, {}, "factor 'f' must have at least one number in each row"),
        ("ab", {"f": np.ones((2, 2))}, {"who": np.ones((2, 2))}, "label 'who' must have one value in each"),
        ("ab", {"f": np.ones((2, 2))}, {"f": np.ones(2)}, "column name 'f' is used twice"),
        ("ab", {"file": np.ones((2, 2))}, {}, "column name 'file' is used twice"),
        ("ab", {"f": np.array([[1.0], [np.inf]])}, {}, "factor 'f' is not finite in 1 of 2 rows, first in b"),
        ("ab", {}, {}, "at least one factor"),
    ],
)
def test_wrong_tables_cannot_be_made(files, factors, labels, message):
    with pytest.raises(ValueError, match=message):
        FeatureTable(tuple(files), factors, labels)


def test_concatenate_follows_the_order_asked_for_and_names_the_nearest():
    table = make()
    both = table.concatenate(("albedo", "geometry"))
    np.testing.assert_array_equal(both[:, :3], table.factors["albedo"])
    np.testing.assert_array_equal(both[:, 3:], table.factors["geometry"])
    assert both.dtype == np.float32 and repr(table) == "5 rows: geometry 4, albedo 3; labels: none"
    np.testing.assert_array_equal(table.concatenate("albedo"), table.factors["albedo"])
    np.testing.assert_array_equal(table.concatenate(), table.concatenate(("geometry", "albedo")))
    with pytest.raises(ValueError, match=r"factor 'albdo'; did you mean 'albedo'\?; there is geometry"):
        table.concatenate(("albdo",))
    with pytest.raises(ValueError, match="name at least one factor"):
        table.concatenate(())
    with pytest.raises(ValueError, match="unknown label 'who'; there is none"):
        table.label("who")


def test_select_takes_slices_indices_and_masks():
    table = make(who=np.array(list("abcde")))
    for rows in (slice(1, 4), [1, 2, 3], np.array([False, True, True, True, False])):
        part = table.select(rows)
        assert part.files == ("1.jpg", "2.jpg", "3.jpg") and len(part) == 3
        assert part.label("who").tolist() == ["b", "c", "d"]
        np.testing.assert_array_equal(part.factors["albedo"], table.factors["albedo"][1:4])
    assert table.select([4, 0]).files == ("4.jpg", "0.jpg")
    assert table.select([]).files == ()


def test_mean_by_averages_groups_and_keeps_what_is_constant():
    who, track = np.array(["a", "a", "b", "a", "b", ""]), np.array([0, 0, 0, 1, 0, 0])
    weight = np.array([np.nan, np.nan, 2, 3, 2, 1])
    table = make(6, identity=who, track=track, frame=np.arange(6), weight=weight)
    means = table.mean_by("identity", "track")
    assert means.files == ("a/0", "b/0", "a/1")
    g = table.factors["geometry"]
    expected = [g[[0, 1]].mean(0), g[[2, 4]].mean(0), g[3]]
    np.testing.assert_allclose(means.factors["geometry"], expected, rtol=1e-6)
    assert means.label("identity").tolist() == ["a", "b", "a"] and means.label("track").tolist() == [0, 0, 1]
    assert "frame" not in means.labels
    np.testing.assert_array_equal(means.label("weight"), [np.nan, 2, 3])
    assert means.origin["mean_by"] == ["identity", "track"]
    with pytest.raises(ValueError, match="name labels to average by; there is identity"):
        table.mean_by()


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (np.array(["", "a"]), [True, False]),
        (np.array([np.nan, 0.0]), [True, False]),
        (np.array([None, np.nan, "", 0, "a"], dtype=object), [True, True, True, False, False]),
        (np.array([-1, 0, 1], np.int8), [True, False, False]),
        (np.array([-1, 0, 1]), [False, False, False]),
        (np.array([False, True]), [False, False]),
    ],
)
def test_missing_knows_every_way_to_be_missing(labels, expected):
    assert missing(labels).tolist() == expected


def test_features_are_those_of_the_model_whatever_the_batch(model, pictures):
    expected = model.eval().embed(torch.from_numpy(pictures.images).float() / 255)
    for size in (1, 4, 11, 100):
        seen: list[tuple[int, int]] = []
        table = embed_image_set(model, pictures, batch_size=size, progress=lambda *at, to=seen: to.append(at))
        assert seen == [(min(end, 11), 11) for end in range(size, 11 + size, size)]
        for name in expected:
            np.testing.assert_allclose(table.factors[name], expected[name].detach(), rtol=1e-5, atol=1e-5)


def test_labels_partition_and_origin_go_with_the_features(model, pictures, tmp_path):
    table = embed_image_set(model, pictures, origin={"model": "runs/x"})
    assert table.files == pictures.files
    assert table.label("identity").tolist() == pictures.labels["identity"].tolist()
    assert table.label("partition").tolist() == ["train"] * 6 + ["test"] * 5
    assert table.origin["model"] == "runs/x" and table.origin["data"] == "made"
    assert table.origin["weights"] == model_fingerprint(model)
    assert FeatureTable.read(table.write(tmp_path / "t.parquet")).origin == table.origin
