"""Embedding to a file gives the table that embedding in memory gives, however often it was stopped; a damaged
part is made again from there, and the user is told."""

import json
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from filelock import FileLock
from tests.data.conftest import encode, noise, write_tree
from tests.data.stream.conftest import write_shard
from tests.features.conftest import assert_same
from tests.trust.test_kills import flip

from derender.data import ImageSet, open_images, read_images
from derender.features import FeatureTable, embed_image_set, embedding
from derender.features.blocks import BlockEmbedder
from derender.features.embedding import embed_to_file
from derender.storage.atomic import DamageNoticed
from derender.training.process import LOCK_FILE

COUNT = 110


def png(seed: int) -> bytes:
    return encode(noise(seed, 8, 8))


def contents() -> dict[str, bytes]:
    """Images in two classes, some unreadable, some copies of earlier ones, also at the very end."""
    files = {f"{'cat' if row % 3 else 'dog'}/{row:03d}.png": png(row) for row in range(COUNT)}
    names = list(files)
    for row in (0, 5, 31, 32, 70, COUNT - 1):
        files[names[row]] = b"no picture"
    for row in (8, 64, 100, COUNT - 2):
        files[names[row]] = png(7)
    return files


@pytest.fixture(autouse=True)
def small_parts(monkeypatch, tmp_path):
    monkeypatch.setattr(embedding, "PART_ROWS", 20)
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))


@pytest.fixture(params=["folder", "zip", "shards"])
def source(request, tmp_path) -> str:
    """The same images in three forms; the shards bring labels of several kinds along."""
    files = contents()
    if request.param != "shards":
        return str(write_tree(tmp_path / "set", files, request.param == "zip"))
    for number in range(2):
        members = {}
        for row, (name, data) in enumerate(files.items()):
            if row * 2 // COUNT == number:
                labels = {"n": row, "who": f"p{row}"} if row < 90 else {"n": row / 2, "late": row % 2 == 0}
                members |= {name: data, f"{name.removesuffix('.png')}.json": json.dumps(labels)}
        write_shard(tmp_path / f"train-{number}.tar", members)
    return str(tmp_path / "train-{0..1}.tar")


def in_memory(model, source: str, path: Path, **options) -> FeatureTable:
    """The table of the whole set in memory, once through a file as any table goes."""
    images = read_images(source, 8, **options)
    return FeatureTable.read(embed_image_set(model, images, batch_size=16).write(path))


def streamed(model, source: str, path: Path, *, limit: int | None = None, **options):
    """The table of the set as a stream."""
    with open_images(source, limit=limit) as stream:
        return embed_to_file(stream, model, path, **{"batch_size": 16, **options})


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "out.parquet"


def stop_after(rows: int, how=KeyboardInterrupt):
    """A report of progress that ends a run once it is beyond so many rows."""

    def stop(done: int, total: int) -> None:
        if done > rows:
            raise how

    return stop


@pytest.mark.parametrize("keep", [False, True])
def test_the_table_is_that_of_the_set_in_memory(model, source, tmp_path, out, keep):
    expected, seen = in_memory(model, source, tmp_path / "m.parquet", keep_duplicates=keep), []
    model.train()
    how = {"keep_duplicates": keep, "progress": lambda *state: seen.append(state)}
    done = streamed(model, source, out, workers=2, **how)
    assert model.training
    assert seen[-1] == (COUNT, COUNT) and all(done <= total for done, total in seen)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert_same(FeatureTable.read(out), expected)
    assert (done.rows, done.skipped, done.copies, done.resumed) == (len(expected), 6, 4, 0)
    assert done.factors == {"geometry": 3, "albedo": 2} and list(done.labels) == list(expected.labels)
    assert done.examples[0].reason == "not an image in a known format"
    assert pq.ParquetFile(out).num_row_groups == -(-len(expected) // 32)
    assert not (tmp_path / "out.parquet.partial").exists()


@pytest.mark.parametrize("keep", [False, True])
def test_blocks_of_several_workers_make_the_same_table(model, source, tmp_path, out, keep, monkeypatch):
    expected = in_memory(model, source, tmp_path / "m.parquet", keep_duplicates=keep)

    @contextmanager
    def two_workers(net, stream, start, *, open_stream, batch_size, fit, workers):
        made = [BlockEmbedder(net, open_stream, batch_size, fit) for _ in range(workers)]
        turns = enumerate(range(start, COUNT, batch_size))
        blocks = [made[turn % 3 == 1].embed(first) for turn, first in turns]
        again = made[0].embed(start)  # a worker may get a block that another one lost
        assert [one.file for one in again[0]] == [one.file for one in blocks[0][0]]
        yield iter(blocks)
        for worker in made:
            worker.opened.close()

    monkeypatch.setattr(embedding, "ray_blocks", two_workers)
    done = embed_to_file(source, model, out, batch_size=16, keep_duplicates=keep, engine="ray")
    assert_same(FeatureTable.read(out), expected)
    assert (done.rows, done.skipped, done.copies) == (len(expected), 6, 4)
    with pytest.raises(ValueError, match="unknown engine 'rai'; did you mean 'ray'"):
        embed_to_file(source, model, out, engine="rai")


@pytest.mark.parametrize("source", ["folder", "shards"], indirect=True)
@pytest.mark.parametrize(
    ("how", "stop_at"),
    [(KeyboardInterrupt, [40]), (KeyboardInterrupt, [0, 60, 60, 100]), (RuntimeError, [10, 90])],
)
def test_a_stopped_run_goes_on_to_the_same_table(model, source, tmp_path, out, stop_at, how, monkeypatch):
    """Stopped by Ctrl-C (what is computed is kept) or killed (what is written is kept)."""
    expected, embedded = in_memory(model, source, tmp_path / "m.parquet"), []
    real = model.embed
    monkeypatch.setattr(model, "embed", lambda images: embedded.append(len(images)) or real(images))
    for stop in stop_at:
        with pytest.raises(how) as stopped:
            streamed(model, source, out, progress=stop_after(stop, how))
        assert not out.exists()
        if how is KeyboardInterrupt:
            parts = (tmp_path / "out.parquet.partial").glob("part-*")
            kept = sum(pq.ParquetFile(part).metadata.num_rows for part in parts)
            assert 0 < kept <= sum(embedded) <= kept + 4, "what was computed is kept, but for copies"
            assert f"stopped by Ctrl-C; {kept} rows are kept in" in str(stopped.value)
    done = streamed(model, source, out)
    assert_same(FeatureTable.read(out), expected)
    assert done.skipped == 6 and done.copies == 4
    if how is KeyboardInterrupt:
        assert done.resumed > 0 and sum(embedded) == len(expected) + 4, "nothing was computed twice"
    assert not (tmp_path / "out.parquet.partial").exists()


@pytest.mark.parametrize("source", ["shards"], indirect=True)
def test_a_set_is_written_as_a_stream_is(model, source, tmp_path, out):
    images = read_images(source, 8)
    part = images.select(np.arange(len(images)) % 2 == 0)
    expected = FeatureTable.read(embed_image_set(model, part, batch_size=16).write(tmp_path / "m.parquet"))
    with pytest.raises(KeyboardInterrupt, match="the same command continues"):
        embed_to_file(part, model, out, batch_size=16, progress=stop_after(30))
    assert embed_to_file(part, model, out, batch_size=16).resumed == 32
    assert_same(FeatureTable.read(out), expected)


@pytest.mark.parametrize("source", ["zip"], indirect=True)
def test_parts_of_another_run_are_an_error_until_told(model, source, tmp_path, out):
    with pytest.raises(KeyboardInterrupt):
        streamed(model, source, out, progress=stop_after(0))
    with pytest.raises(ValueError, match=r"unfinished table .*\(differs in batch_size\): delete"):
        streamed(model, source, out, batch_size=8)
    model.b[0, 0] += 1
    with pytest.raises(ValueError, match=r"differs in origin.*add --force"):
        streamed(model, source, out)
    with FileLock(f"{out}.partial/{LOCK_FILE}"), pytest.raises(ValueError, match="by another process"):
        streamed(model, source, out, fresh=True)
    assert streamed(model, source, out, fresh=True).resumed == 0
    assert_same(FeatureTable.read(out), in_memory(model, source, tmp_path / "m.parquet"))


def test_bad_input_leaves_nothing(model, tmp_path, out):
    bad = tmp_path / "bad"
    bad.mkdir()
    for name in ("a.png", "b.png"):
        (bad / name).write_bytes(b"text")
    with pytest.raises(ValueError, match=r"no image in .*bad \(folder\) can be read; the first is 'a\.png'"):
        streamed(model, str(bad), out)
    with pytest.raises(ValueError, match="batch_size must be 1 or more, got 0"):
        streamed(model, str(bad), out, batch_size=0)
    with pytest.raises(ValueError, match="is a folder: name a file"):
        streamed(model, str(bad), bad)
    (bad / "c.png").write_bytes(png(1))
    model.b[:] = np.nan
    with pytest.raises(ValueError, match=r"factor 'albedo' is not finite in 1 of 1 rows, first in c\.png"):
        streamed(model, str(bad), out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad"]
    (tmp_path / "out.parquet.partial").write_text("in the way")
    with pytest.raises(ValueError, match="in the way: delete it"):
        streamed(model, str(bad), out)


@pytest.fixture
def pictures() -> ImageSet:
    images = np.random.default_rng(0).integers(0, 256, (60, 3, 8, 8), dtype=np.uint8)
    return ImageSet(images, tuple(f"{number}.png" for number in range(60)), source="made")


@pytest.fixture
def stopped(model, pictures, tmp_path, monkeypatch):
    """A table of which six parts of eight rows were written when Ctrl-C came."""
    monkeypatch.setattr(embedding, "PART_ROWS", 8)

    with pytest.raises(KeyboardInterrupt):
        embed_to_file(pictures, model, tmp_path / "F.parquet", batch_size=8, progress=stop_after(47))
    return sorted((tmp_path / "F.parquet.partial").glob("part-*"))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda file: flip(file, 0.5), "its checksum differs"),
        (lambda file: file.write_bytes(file.read_bytes()[:-1]), "its checksum differs"),
        (lambda file: file.write_bytes(b""), "its checksum differs"),
        (lambda file: file.unlink(), "part 2 is missing"),
    ],
)
def test_a_damaged_part_is_made_again_with_those_after_it(model, pictures, stopped, tmp_path, damage, words):
    assert len(stopped) == 6
    damage(stopped[2])
    with pytest.warns(DamageNoticed, match=rf"damaged \({words}\): going on from the 16 rows before it"):
        done = embed_to_file(pictures, model, tmp_path / "F.parquet", batch_size=8)
    assert (done.resumed, done.rows) == (16, 60)
    expected = embed_image_set(model, pictures, batch_size=8)
    assert_same(FeatureTable.read(tmp_path / "F.parquet"), expected)
    assert not list(tmp_path.glob("*.partial"))


def test_what_a_run_leaves_that_was_killed_before_its_first_part_is_no_obstacle(model, pictures, tmp_path):
    folder = tmp_path / "F.parquet.partial"
    folder.mkdir()
    (folder / ".plan.json-abc").write_text("{")
    (folder / "plan.json").write_text('{"other": 1}')
    (folder / ".writing.parquet-x").write_bytes(b"PAR1")
    assert embed_to_file(pictures, model, tmp_path / "F.parquet").rows == 60


@pytest.mark.parametrize("at", [0.2, 0.4, 0.6])
def test_a_changed_byte_in_a_finished_table_is_an_error_and_not_another_number(model, pictures, tmp_path, at):
    file = tmp_path / "F.parquet"
    embed_to_file(pictures, model, file)
    wanted = FeatureTable.read(file)
    flip(file, at)
    try:
        assert_same(FeatureTable.read(file), wanted)
    except ValueError as problem:
        assert "not a readable parquet file" in str(problem) or str(file) in str(problem)
