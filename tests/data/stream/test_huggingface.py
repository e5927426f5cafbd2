"""Hugging Face data sets in the forms their library writes, without a network; ids that cannot be read."""

import sys
from pathlib import Path

import huggingface_hub
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image as Pillow

from derender.data import open_images, read_images

datasets = pytest.importorskip("datasets", reason="needs the extra: pip install 'derender[huggingface]'")


@pytest.fixture(autouse=True)
def places(tmp_path, monkeypatch) -> Path:
    """A cache of the library's own, and no network."""
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "hf")
    monkeypatch.chdir(tmp_path)
    datasets.disable_progress_bars()
    return tmp_path


def pixels(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (9, 9, 3), dtype=np.uint8)


@pytest.fixture
def rows():
    """``rows(count, first)``: images of their own, a class, a number, a text, a list."""

    def make(count: int, first: int = 0, **more: object):
        number, whole = range(first, first + count), datasets.Value("int32")
        kinds = {"photo": datasets.Image(), "label": datasets.ClassLabel(names=["cat", "dog"]), "age": whole}
        kinds |= {"note": datasets.Value("string"), "box": datasets.Sequence(whole)}
        features = datasets.Features({**kinds, **{name: datasets.Image() for name in more}})
        pictures = [Pillow.fromarray(pixels(seed)) for seed in number]
        columns = {"photo": pictures, "label": [seed % 2 if seed != 3 else -1 for seed in number]}
        columns["age"] = [seed if seed != 2 else None for seed in number]
        columns |= {"note": [f"n{seed}" for seed in number], "box": [[0, 1]] * count}
        columns |= dict.fromkeys(more, pictures)
        return datasets.Dataset.from_dict(columns, features=features)

    return make


def check(pictures, count: int, split: str = "train", encoded=None) -> None:
    assert pictures.layout == "huggingface"
    assert pictures.files == tuple(f"{split}/{row:08d}" for row in range(count))
    for row in range(count):
        np.testing.assert_array_equal(pictures.images[row], pixels(row).transpose(2, 0, 1))
    assert set(pictures.labels) == {"label", "age", "note"}
    assert pictures.label("label").tolist()[:4] == ["cat", "dog", "cat", ""]
    age = pictures.label("age")
    assert age.dtype == np.float32 and np.isnan(age[2]) and age[4] == 4
    assert pictures.label("note").tolist() == [f"n{row}" for row in range(count)]


def test_parquet_as_on_the_hub(rows, places):
    folder = places / "set" / "data"
    folder.mkdir(parents=True)
    rows(3).to_parquet(folder / "train-00000-of-00002.parquet")
    rows(4, 3).to_parquet(folder / "train-00001-of-00002.parquet")
    rows(2, 50).to_parquet(folder / "test-00000-of-00001.parquet")
    check(read_images("set", 9), 7)
    check(read_images("set", 9), 7)  # from the cache
    assert read_images("set::test", 9).files == ("test/00000000", "test/00000001")
    every = read_images("set::all", 9)
    assert every.partition.tolist().count("train") == 7 and every.partition.tolist().count("test") == 2
    assert len(read_images("set", 9, limit=2)) == 2
    with pytest.raises(ValueError, match=r"set::tset: it has no split 'tset'; did you mean 'test'\?"):
        read_images("set::tset", 9)
    single = folder / "test-00000-of-00001.parquet"
    assert len(read_images(single, 9)) == 2


def test_saved_to_disk(rows, places):
    rows(6).save_to_disk("one")
    check(read_images("one", 9), 6)
    datasets.DatasetDict({"train": rows(5), "test": rows(2)}).save_to_disk("two")
    check(read_images("two", 9), 5)
    assert len(read_images("two::test", 9)) == 2
    assert len(read_images("two::all", 9, keep_duplicates=True)) == 7


def test_a_stream_goes_on_in_the_middle_of_its_splits(rows, places):
    datasets.DatasetDict({"train": rows(5), "test": rows(3, 10)}).save_to_disk("two")
    with open_images("two::all") as stream:
        names = [sample.file for sample in stream.samples()]
        assert len(names) == 8
        for start in (0, 3, 5, 6, 8):
            rest = list(stream.samples(start))
            assert [sample.file for sample in rest] == names[start:]
            assert not rest or rest[-1].share == 1


def test_no_picture_column_and_several(rows, places):
    rows(3).remove_columns("photo").to_parquet("none.parquet")
    with pytest.raises(ValueError, match=r"none\.parquet has no column of images; its columns are label"):
        read_images("none.parquet", 9)
    rows(5, other=1).to_parquet("both.parquet")
    with pytest.raises(ValueError, match=r"several columns of images \(photo, other\); name one:"):
        read_images("both.parquet", 9)
    check(read_images("both.parquet?column=other", 9), 5)
    with pytest.raises(ValueError, match=r"no column of images 'photos'; did you mean 'photo'"):
        read_images("both.parquet?column=photos", 9)
    with pytest.raises(ValueError, match=r"\?half= is for folders, zips and tables"):
        read_images("both.parquet?half=test", 9)


def test_rows_that_only_point_at_a_file_outside_are_not_followed(places, encoded):
    (places / "secret.png").write_bytes(encoded(1))
    (places / "set").mkdir()
    (places / "set" / "in.png").write_bytes(encoded(2))
    schema = datasets.Features({"image": datasets.Image()}).arrow_schema
    pointing = [{"bytes": None, "path": "../secret.png"}, {"bytes": None, "path": "in.png"}, None]
    pq.write_table(pa.table({"image": pointing}, schema=schema), "set/rows.parquet")
    pictures = read_images("set/rows.parquet", 12)
    assert len(pictures) == 1
    assert "which is not in the data set" in pictures.skipped[0].reason
    assert pictures.skipped[1].reason == "no image in this row"


def test_a_path_wins_and_an_id_that_cannot_be_reached_names_both_readings(places, encoded, monkeypatch):
    asked = []

    def unreachable(self, identifier, **_: object):
        asked.append(identifier)
        raise OSError("no route")

    monkeypatch.setattr(huggingface_hub.HfApi, "dataset_info", unreachable)
    (places / "owner").mkdir()
    (places / "owner" / "name").mkdir()
    (places / "owner" / "name" / "a.png").write_bytes(encoded(1))
    assert len(read_images("owner/name", 8)) == 1
    assert not asked
    with pytest.raises(ValueError, match=r"owner/nam does not exist here; did you mean 'name'\?; and the"):
        read_images("owner/nam", 8)
    assert asked == ["owner/nam"]
    for path in ("./owner/nam", "owner/nam.zip", "owner/x.jpg", "owner/nam/more"):
        with pytest.raises(ValueError, match="does not exist"):
            read_images(path, 8)
    assert len(asked) == 1


def test_an_id_is_loaded_at_the_commit_the_hub_names(rows, places, monkeypatch):
    """The Hub stands in as a folder: the id, the commit and the configuration reach the library."""
    datasets.DatasetDict({"train": rows(5)}).save_to_disk("hub")
    seen = []

    def load(identifier, config, revision, streaming):
        seen.append((identifier, config, revision, streaming))
        return datasets.load_from_disk("hub")

    answer = type("Info", (), {"sha": "abc123"})
    monkeypatch.setattr(huggingface_hub.HfApi, "dataset_info", lambda self, name, **_: answer)
    monkeypatch.setattr(datasets, "load_dataset", load)
    check(read_images("owner/name?config=small", 9), 5)
    assert seen == [("owner/name", "small", "abc123", True)]


def test_the_missing_library_is_named_with_its_extra(places, monkeypatch):
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(ValueError, match=r"needs the package datasets, .* pip install"):
        read_images("owner/name", 8)
