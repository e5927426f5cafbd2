"""Generator, inversion and Retrieve in Style on the command line, each made from the last."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.cli.conftest import noise, run, settings

from derender import FeatureTable

COMMON = ["batch_size=8", "images=16"]
GENERATOR = ["image_size=32", "style_size=6", "mapping_layers=2", "channel_base=64", "channel_max=6"]
ENCODER = ["image_size=32", "width=4", "units=[1,1,1,1]", "perceptual_weight=0"]


@pytest.fixture(scope="module")
def faces(tmp_path_factory) -> Path:
    """24 images, and for each a mask whose upper third is class 1."""
    folder, mask = tmp_path_factory.mktemp("generators") / "faces", np.zeros((32, 32), np.uint8)
    mask[:10] = 1
    noise(folder / "images", 24, name="{:02d}.png")
    (folder / "masks").mkdir()
    for index in range(24):
        Image.fromarray(mask).save(folder / "masks" / f"{index:02d}.png")
    (folder / "masks" / "classes.txt").write_text("skin\nhair\n")
    return folder


@pytest.fixture(scope="module")
def e4e(faces: Path) -> Path:
    """The run of an encoder that inverts a generator trained for two steps."""
    data, folder = faces / "images", faces.parent
    words = ["train", "--model", "stylegan2", "-d", data, "--out", folder / "gan"]
    assert run(*words, *settings(*COMMON, *GENERATOR)) == 0
    words = ["train", "--model", "e4e", "--generator", folder / "gan", "-d", data, "--out", folder / "e4e"]
    assert run(*words, *settings(*COMMON, *ENCODER)) == 0
    return folder / "e4e"


def test_a_generator_its_inversion_and_its_parts(faces, e4e, tmp_path, capsys):
    data, table = faces / "images", tmp_path / "t.parquet"
    assert (e4e / "report.html").is_file() and list((e4e / "samples").glob("*.png"))
    embed = ["embed", "-d", data, "--out", table, "--force", "--baseline"]
    assert run(*embed, "e4e", "--model", e4e, "--part", "test") == 0
    read = FeatureTable.read(table)
    assert read.factors["w+"].shape == (2, 8 * 6) and read.origin["part"] == "test"
    assert run(*embed, "stylegan2", "--model", e4e.parent / "gan") == 0
    assert FeatureTable.read(table).factors["discriminator"].shape == (24, 6)

    train = ["train", "--model", "ris", "-d", data, "--out", tmp_path / "ris"]
    own = settings(f"e4e={e4e}", f"masks={faces / 'masks'}", "image_size=32", "clusters=3", "samples=16")
    assert run(*train, *own) == 0
    assert "24 images" in capsys.readouterr().err
    (sheet,) = (tmp_path / "ris" / "samples").iterdir()
    assert sheet.suffix == ".png"
    assert run(*embed, "ris", "--model", tmp_path / "ris") == 0
    factors = FeatureTable.read(table).factors
    assert set(factors) == {"skin", "hair", "pose"}
    space = 6 * 6 + 3 * 4 + 2 * 2  # inputs at 4 and 8 pixels are 6 wide, at 16 pixels 4, at 32 pixels 2
    assert {values.shape for values in factors.values()} == {(24, space)}
    search = ["search", "--features", table, "--factor", "pose", "--like", "03.png", "-k", "2"]
    assert run(*search) == 0


def test_what_is_missing_is_one_line(faces, e4e, tmp_path, refused):
    train = ("train", "-d", faces / "images", "--out", tmp_path / "run", "--model")
    assert "for e4e as --set generator=RUN" in refused(*train, "e4e")
    assert "unknown setting 'generator'" in refused(*train, "ae", "--generator", e4e)
    assert "for ris as --set e4e=RUN" in refused(*train, "ris")
    small = settings(f"e4e={e4e}")
    assert "set image_size=32" in refused(*train, "ris", *small)
    assert "holds no masks" in refused(*train, "ris", *small, "--set", "image_size=32")
    assert not (tmp_path / "run").exists()
