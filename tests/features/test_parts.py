"""An unfinished table of which a part is damaged is made again from there, and the user is told."""

import numpy as np
import pytest
from tests.features.conftest import assert_same

from derender.data import ImageSet
from derender.features import FeatureTable, embed_image_set, embedding
from derender.features.embedding import embed_to_file
from derender.storage.atomic import DamageNoticed


@pytest.fixture
def pictures() -> ImageSet:
    images = np.random.default_rng(0).integers(0, 256, (60, 3, 8, 8), dtype=np.uint8)
    return ImageSet(images, tuple(f"{number}.png" for number in range(60)), source="made")


@pytest.fixture
def stopped(model, pictures, tmp_path, monkeypatch):
    """A table of which six parts of eight rows were written when Ctrl-C came."""
    monkeypatch.setattr(embedding, "PART_ROWS", 8)

    def press_ctrl_c(done: int, total: int) -> None:
        if done >= 48:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        embed_to_file(pictures, model, tmp_path / "F.parquet", batch_size=8, progress=press_ctrl_c)
    return sorted((tmp_path / "F.parquet.partial").glob("part-*"))


def flipped(file) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (flipped, "its checksum differs"),
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
    content = bytearray(file.read_bytes())
    content[int(at * len(content))] ^= 16
    file.write_bytes(content)
    try:
        assert_same(FeatureTable.read(file), wanted)
    except ValueError as problem:
        assert "not a readable parquet file" in str(problem) or str(file) in str(problem)
