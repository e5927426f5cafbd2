"""Written sets read back: through the project's reader, and against the published encodings."""

import csv
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from derender.data import read_images
from derender.data.maps import read_ground_truth, read_masks
from derender.data.synthetic import FaceSettings, faces, write

_TEXTS = ("file", "expression", "hair", "hair_colour", "beard")


@pytest.fixture(scope="module")
def made():
    return faces.generate(6, seed=2)


@pytest.fixture
def folder(made, tmp_path):
    return write(made, tmp_path / "set")


def test_the_reader_gives_back_what_was_written(made, folder):
    read = read_ground_truth(folder)
    assert (read.mask == made.mask).all()
    assert np.abs(read.depth - made.depth).max() < 0.4 / 65535
    assert read.normal is not None and np.abs(read.normal - made.normal).max() < 0.008
    assert read.albedo is not None and np.abs(read.albedo * 255 - made.albedo).max() < 0.01
    assert np.allclose(read.light, made.light, atol=1e-5)
    assert np.allclose(read.camera, made.camera, atol=1e-5)
    assert np.abs(read.images.astype(int) - made.images).mean() < 2.5  # JPEG
    assert read.labels["identity"].astype(int).tolist() == made.identity.tolist()
    assert read.labels["expression"].tolist() == made.expression.tolist()


def test_columns_are_those_of_the_rendered_development_set(folder, shared_data):
    with ZipFile(shared_data("data/synface64.zip")) as archive:
        theirs = archive.read("test_gt/params.csv").decode().splitlines()[0].split(",")
    with (folder / "params.csv").open() as file:
        ours = next(csv.reader(file))
    extra = {"age", "skin_tone", "build", "hair", "hair_colour", "beard"}
    assert extra <= set(ours)
    common = [name for name in theirs if name not in ("expr_weights", "skin_id")]
    assert [name for name in ours if name not in extra] == common


def test_light_columns_agree_with_each_other(made, folder):
    with (folder / "params.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        value = {k: float(v) for k, v in row.items() if k not in _TEXTS}
        slope = [*np.tan(np.deg2rad([value["light_yaw"], value["light_pitch"]])), 1.0]
        direction = np.array([value["lx"], value["ly"], value["lz"]])
        assert np.allclose(direction, slope / np.linalg.norm(slope), atol=2e-6)
        turn = Rotation.from_euler("xyz", [value["pitch"], value["yaw"], value["roll"]], degrees=True)
        seen = turn.apply(direction)  # R = Rz Ry Rx
        assert np.allclose([value["lx_cam"], value["ly_cam"], value["lz_cam"]], seen, atol=5e-6)


def test_without_truth_only_pictures_and_tables_and_never_over_another_set(made, tmp_path):
    folder = write(made, tmp_path / "plain", truth=False)
    assert sorted(path.name for path in folder.iterdir()) == ["identities.csv", "images", "params.csv"]
    with pytest.raises(FileExistsError, match="exists and is not empty"):
        write(made, folder)


def test_parts_read_back_as_masks_for_segmentation(made, folder):
    assert (np.asarray(Image.open(folder / "masks" / "000003.png")) == made.parts[3]).all()
    read = read_masks(folder, 64)
    assert read.classes == made.part_names and (read.masks == made.parts).all()
    assert read.images.label("age").tolist() == made.labels["age"].tolist()


def test_tracks_read_back_as_tracks(tmp_path):
    settings = FaceSettings(tracks=2, frames=3)
    made = faces.generate(12, image_size=16, settings=settings)
    folder = write(made, tmp_path / "set")
    first = [f"tracks/id0000/track_{at}.jpg" for at in ("000/000", "000/001", "000/002", "001/000")]
    assert sorted(str(p.relative_to(folder)) for p in folder.rglob("*.jpg"))[:4] == first
    read = read_images(folder, 16)
    assert len(read) == 12 and len(set(read.label("track").tolist())) >= 2
    assert len(set(read.label("identity").tolist())) == 2
