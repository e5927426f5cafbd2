"""Written sets read back: through the project's reader, and against the published encodings."""

import csv

import numpy as np
import pytest
from PIL import Image

from derender.data.ground_truth import read_ground_truth
from derender.data.synthetic import faces, write


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
    from zipfile import ZipFile

    with ZipFile(shared_data("data/synface64.zip")) as archive:
        theirs = archive.read("test_gt/params.csv").decode().splitlines()[0].split(",")
    with (folder / "params.csv").open() as file:
        ours = next(csv.reader(file))
    assert ours == [name for name in theirs if name not in ("expr_weights", "skin_id")]


def test_light_columns_agree_with_each_other(made, folder):
    with (folder / "params.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        value = {k: float(v) for k, v in row.items() if k not in ("file", "expression")}
        slope = np.array(
            [np.tan(np.deg2rad(value["light_yaw"])), np.tan(np.deg2rad(value["light_pitch"])), 1.0]
        )
        direction = np.array([value["lx"], value["ly"], value["lz"]])
        assert np.allclose(direction, slope / np.linalg.norm(slope), atol=2e-6)
        pitch, yaw, roll = np.deg2rad([value["pitch"], value["yaw"], value["roll"]])
        about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
        about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        seen = about_z @ about_y @ about_x @ direction
        assert np.allclose([value["lx_cam"], value["ly_cam"], value["lz_cam"]], seen, atol=5e-6)


def test_encodings_are_the_published_ones(made, folder):
    depth = np.asarray(Image.open(folder / "depth" / "000003.png"))
    normal = np.asarray(Image.open(folder / "normal" / "000003.png"))
    mask = np.asarray(Image.open(folder / "mask" / "000003.png"))
    assert depth.dtype == np.uint16 and normal.shape == (64, 64, 3) and set(np.unique(mask)) == {0, 255}
    assert (depth[mask == 0] == 0).all() and (normal[mask == 0] == 0).all()
    row, column = np.argwhere(mask)[200]
    assert depth[row, column] == round((float(made.depth[3, row, column]) - 0.8) / 0.4 * 65535)


def test_identities_are_listed_once_with_their_traits(made, folder):
    with (folder / "identities.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["identity"]) for row in rows] == [0]
    assert float(rows[0]["shape_nose_length"]) == pytest.approx(
        made.identity_traits["shape_nose_length"][0], abs=1e-4
    )


def test_without_truth_only_pictures_and_tables(made, tmp_path):
    folder = write(made, tmp_path / "plain", truth=False)
    assert sorted(path.name for path in folder.iterdir()) == ["identities.csv", "images", "params.csv"]


def test_a_folder_that_holds_a_set_is_refused(made, folder):
    with pytest.raises(ValueError, match="already holds a set"):
        write(made, folder)
