"""WebDataset: the images and labels that were packed, whatever the packing; damage is listed, not fatal."""

import json
import tarfile

import numpy as np
import pytest

from derender.data import read_image, read_images
from derender.data.streamed import expand_braces, find_shards


def members(count: int, first: int = 0) -> dict[str, bytes | str | None]:
    """Images with a class and a JSON object each; the seed of image i is 3 i from the shard's first."""
    written: dict[str, bytes | str | None] = {}
    for row in range(first, first + count):
        written[f"{row:04d}.png"] = None
        written[f"{row:04d}.cls"] = str(row % 3)
        written[f"{row:04d}.json"] = json.dumps({"age": row, "who": f"p{row}", "glad": row % 2 == 0})
    return written


@pytest.mark.parametrize(
    ("name", "mode"), [("a.tar", "w"), ("a.tar.gz", "w:gz"), ("a.tar.xz", "w:xz"), ("a.tar.bz2", "w:bz2")]
)
def test_pictures_and_labels_are_those_packed(shard, encoded, name, mode):
    pictures = read_images(shard(name, members(70), mode), 12)
    assert pictures.layout == "webdataset"
    assert pictures.files == tuple(f"{name}/{row:04d}.png" for row in range(70))
    for row in (0, 31, 32, 69):
        np.testing.assert_array_equal(pictures.images[row], read_image(encoded(3 * row), 12))
    assert pictures.label("age").dtype == np.float32 and pictures.label("glad").dtype == np.int8
    labels = {name: column.tolist() for name, column in pictures.labels.items()}
    assert labels.pop("class") == [str(row % 3) for row in range(70)]
    assert labels.pop("who") == [f"p{row}" for row in range(70)]
    assert labels == {"age": list(range(70)), "glad": [1, 0] * 35}
    assert pictures.partition is None and not pictures.skipped


def test_the_same_as_the_folder_it_was_packed_from(tree, shard, encoded):
    """Order, pixels, unreadable ones and copies as if the members lay in a folder."""
    files = {"a.png": None, "b.png": "no image", "c.png": encoded(0), "d.png": None, "e.jpg": b""}
    folder = read_images(tree(files), 8)
    packed = read_images(shard("x.tar", files), 8)
    strip = len("x.tar/")
    assert tuple(file[strip:] for file in packed.files) == folder.files
    np.testing.assert_array_equal(packed.images, folder.images)
    faults = [(one.file[strip:], one.reason) for one in packed.skipped]
    assert faults == [(one.file, one.reason) for one in folder.skipped]
    copies = [(one.file[strip:], one.first[strip:]) for one in packed.duplicates]
    assert copies == [(one.file, one.first) for one in folder.duplicates]
    kept = read_images(shard("x.tar", files), 8, keep_duplicates=True)
    assert len(kept) == 3 and kept.duplicates == packed.duplicates


def test_names_with_braces_a_folder_and_its_parts(shard, tmp_path):
    for number in range(3):
        shard(f"set/train-{number:03d}.tar", members(4, 4 * number), first=100 * number)
    shard("set/val-000.tar", members(2, 50), first=500)
    pattern = str(tmp_path / "set" / "train-{000..002}.tar")
    assert len(read_images(pattern, 8)) == 12
    assert len(read_images(str(tmp_path / "set" / "{train,val}-000.tar"), 8)) == 6
    whole = read_images(tmp_path / "set", 8)
    assert whole.partition.tolist() == ["train"] * 12 + ["validation"] * 2
    assert len(read_images(f"{tmp_path / 'set'}::val", 8)) == 2
    assert len(read_images(tmp_path / "set", 8, subset="train", limit=5)) == 5
    assert len(find_shards(tmp_path / "set", "set")) == 4
    assert list(expand_braces("a{8..10}b{x,y}")) == ["a8bx", "a8by", "a9bx", "a9by", "a10bx", "a10by"]
    assert list(expand_braces("{008..010}")) == ["008", "009", "010"]
    for bad in ("{3..1}.tar", "{abc}.tar", "{0..99999999}.tar"):
        with pytest.raises(ValueError, match=r"must count|should read"):
            list(expand_braces(bad))
    with pytest.raises(ValueError, match=r"no shards of a part 'tes'; there are set, train, val"):
        read_images(f"{tmp_path / 'set'}::tes", 8)
    with pytest.raises(ValueError, match=r"2 of the 5 shards of .* do not exist; the first is .*train-003"):
        read_images(str(tmp_path / "set" / "train-{000..004}.tar"), 8)


@pytest.mark.parametrize("where", ["inside an image", "inside a header", "between members"])
def test_of_a_truncated_shard_counts_what_comes_before(shard, where):
    path = shard("cut.tar", {f"{row}.png": None for row in range(10)})
    with tarfile.open(path) as tar:
        seventh = tar.getmembers()[7]
    cut = {"inside an image": seventh.offset_data + 100, "inside a header": seventh.offset + 200}
    cut = cut.get(where, seventh.offset)
    path.write_bytes(path.read_bytes()[:cut])
    pictures = read_images(path, 8)
    assert pictures.files == tuple(f"cut.tar/{row}.png" for row in range(7))
    (fault,) = pictures.skipped
    assert fault.file == "cut.tar" and "damaged or cut short, what comes before counts" in fault.reason
    assert "1 skipped" in pictures.describe()


def test_a_damaged_shard_does_not_end_the_others(shard, tmp_path):
    shard("s/0.tar", members(3))
    (tmp_path / "s/1.tar").write_bytes(b"no tar at all" * 100)
    (tmp_path / "s/2.tar").write_bytes(b"")
    packed = shard("s/3.tar.gz", members(40, 10), "w:gz", first=300)
    packed.write_bytes(packed.read_bytes()[:-400])
    header = shard("s/4.tar", {f"{row}.png": None for row in range(4)}, first=900)
    raw = bytearray(header.read_bytes())
    with tarfile.open(header) as tar:
        raw[tar.getmembers()[2].offset + 150] ^= 0xFF
    header.write_bytes(raw)
    pictures = read_images(tmp_path / "s", 8)
    count = sum(file.startswith("3.tar.gz") for file in pictures.files)
    assert 10 < count <= 40
    assert len(pictures) == 3 + count + 2
    assert [row.file for row in pictures.skipped] == ["1.tar", "2.tar", "3.tar.gz", "4.tar"]


def test_several_pictures_in_a_sample_are_a_question(shard):
    path = shard("p.tar", dict.fromkeys(("1.jpg", "1.seg.png", "2.jpg", "2.seg.png", "3.seg.png")))
    with pytest.raises(ValueError, match=r"'1' in p\.tar has several images \(jpg, seg\.png\); name one:"):
        read_images(path, 8)
    jpgs = read_images(f"{path}?column=jpg", 8)
    assert jpgs.files == ("p.tar/1.jpg", "p.tar/2.jpg")
    assert [row.reason for row in jpgs.skipped] == ["no 'jpg' in this sample (it has seg.png)"]
    assert len(read_images(f"{path}?column=seg.png", 8)) == 3
    with pytest.raises(ValueError, match=r"unknown option of .* 'colum'; did you mean 'column'"):
        read_images(f"{path}?colum=jpg", 8)


def test_hostile_names_and_members_write_nothing_and_read_nothing_outside(shard, tmp_path, encoded):
    (tmp_path / "secret.png").write_bytes(encoded(77))
    path = shard("evil.tar", dict.fromkeys(("../out.png", "/abs/out2.png", "./fine.png")))
    with tarfile.open(path, "a") as tar:
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE):
            info = tarfile.TarInfo("link.png")
            info.type, info.linkname = kind, str(tmp_path / "secret.png")
            tar.addfile(info)
    before = sorted(file for file in tmp_path.rglob("*") if "cache" not in file.parts)
    pictures = read_images(path, 8)
    assert len(pictures) == 3
    assert sorted(file for file in tmp_path.rglob("*") if "cache" not in file.parts) == before


def test_labels_that_are_missing_mixed_too_large_or_no_labels(shard):
    first = json.dumps({"id": 1 << 30, "mixed": 1, "late": None, "list": [1], "file": "old.png"})
    third = json.dumps({"id": 7, "mixed": "one", "late": 2.5, "yes": True})
    whole = {"1.png": None, "1.json": first, "2.png": None, "3.png": None, "3.json": third}
    broken = {"4.png": None, "4.json": "[1, 2]", "5.png": None, "5.json": "{", "6.txt": "no image"}
    pictures = read_images(shard("l.tar", whole | broken), 8)
    labels = {name: column.tolist() for name, column in pictures.labels.items()}
    assert labels.pop("late")[2] == 2.5
    assert labels.pop("id") == [str(1 << 30), "", "7"] and labels.pop("mixed") == ["1", "", "one"]
    assert labels == {"original_file": ["old.png", "", ""], "yes": [-1, -1, 1]}
    assert [row.file for row in pictures.skipped] == ["l.tar/4.png", "l.tar/5.png", "l.tar/6"]
