"""Images of the page: examples such as the models know, opened ones in bounded memory, rows of a table."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tests.cli.conftest import noise
from tests.report.viewer.serving import serving

from derender import load
from derender.data import read_images
from derender.features import FeatureTable, embed_image_set
from derender.features.neighbours import nearest
from derender.photo import Frame
from derender.report.viewer.app import Application
from derender.report.viewer.images import Gallery, Shelf, ShownImage, rendered_examples
from derender.report.viewer.questions import Refused
from derender.report.viewer.studio import Studio
from derender.scene import Scene
from derender.storage.places import bundled_models, model_folder
from derender.training.held_out_errors import OUTLIER_PERCENTILE, read_errors, reconstruction_percentile

SIZE = 32


@pytest.mark.parametrize("model", ["faces-64", "rendered-faces-64", "cars-64"])
def test_rendered_examples_are_known_to_the_model_and_differ(model):
    examples = rendered_examples(model)
    assert [example.name for example in examples] == [f"example {number}" for number in range(1, 9)]
    assert len({example.picture.tobytes() for example in examples}) == 8
    stacked = np.stack([np.asarray(example.thumbnail(64)) for example in examples]).transpose(0, 3, 1, 2)
    net, errors = load(model), read_errors(model_folder(model))
    assert errors is not None
    result = reconstruction_percentile(net, stacked, errors)
    assert (result <= OUTLIER_PERCENTILE).all() and np.median(result) < 90


def test_every_bundled_model_has_examples_and_others_have_none(tmp_path):
    assert all(rendered_examples(name) for name in bundled_models())
    assert rendered_examples(str(tmp_path / "faces")) == []


@pytest.fixture
def image() -> ShownImage:
    scene = Scene(torch.ones(1, 4, 4), torch.zeros(1, 3, 4, 4), torch.zeros(1, 4), torch.zeros(1, 6))
    small = np.zeros((3, 4, 4), np.uint8)
    return ShownImage(np.zeros((9, 9, 3), np.uint8), (), Frame.centred(9, 9), "none", small, scene, {})


def test_the_longest_unused_image_leaves_first(image):
    shelf = Shelf(3)
    first, second, third = (shelf.put(image) for _ in range(3))
    shelf.get(first)
    fourth = shelf.put(image)
    assert len(shelf) == 3 and all(shelf.get(name) is image for name in (first, third, fourth))
    with pytest.raises(Refused, match="no longer stored") as refused:
        shelf.get(second)
    assert refused.value.status == 410
    with pytest.raises(ValueError, match="room for 2"):
        Shelf(1)


def test_photographs_take_no_more_memory_than_allowed(image):
    shelf = Shelf(10, limit_bytes=3 * image.photo.nbytes)
    for _ in range(5):
        shelf.put(replace(image, photo=image.photo.copy()))
    assert len(shelf) == 3
    crops = Shelf(10, limit_bytes=image.photo.nbytes)
    for _ in range(5):
        crops.put(image)  # crops of one photograph
    assert len(crops) == 5


def test_names_cannot_be_guessed(image):
    names = {Shelf(200).put(image) for _ in range(200)}
    assert len(names) == 200 and all(re.fullmatch(r"[A-Za-z0-9_-]{22}", name) for name in names)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return noise(tmp_path_factory.mktemp("rows"), 6, SIZE, cells=6)


@pytest.fixture(scope="module")
def table(model, folder) -> FeatureTable:
    return embed_image_set(model, read_images(folder, SIZE), origin={"data": str(folder)})


def test_neighbours_of_a_picture_of_the_table(model, folder, table, client):
    with serving(Application(Studio(model, "tiny", Shelf(2), gallery=Gallery(table)))) as url:
        visitor = type(client)(url)
        assert visitor.get("/api/about").json["table"] == {
            "rows": 6, "factors": ["geometry", "albedo", "light", "camera"], "note": "",
        }  # fmt: skip
        name = visitor.post("/api/pictures", (folder / "3.png").read_bytes()).json["picture"]
        result = visitor.post("/api/neighbours", {"picture": name, "factor": "albedo", "k": 3}).json["rows"]
        rows = table.factors["albedo"]
        (first,), (away,) = nearest(table, rows[3], "albedo", 1, exclude=[3])  # itself is no neighbour
        assert [result[0]["row"], result[0]["file"]] == [first, f"{first}.png"]
        assert result[0]["distance"] == pytest.approx(away, abs=1e-5)
        assert [row["distance"] for row in result] == sorted(row["distance"] for row in result)
        assert all(row["image"].startswith("data:image/png;base64,") for row in result)
        other = visitor.post("/api/rows/4").json["picture"]
        asked = {"picture": name, "swaps": {"albedo": other}, "factor": "albedo", "k": 1}
        (second,), _ = nearest(table, rows[4], "albedo", 1, exclude=[4])
        assert visitor.post("/api/neighbours", asked).json["rows"][0]["row"] == second
        reply = visitor.post("/api/neighbours", {"picture": name, "factor": "albdo"})
        assert (reply.status, "albedo" in reply.error) == (422, True)
        assert visitor.post("/api/rows/6").status == 404


def test_names_that_lead_out_of_the_data_are_not_followed(table, folder, tmp_path):
    secret = tmp_path / "secret.png"
    Image.new("RGB", (8, 8)).save(secret)
    names = (str(secret), f"../{tmp_path.name}/secret.png", *table.files[2:])
    gallery = Gallery(FeatureTable(names, table.factors, origin=table.origin), str(folder))
    assert gallery.picture(2, 8).shape == (3, 8, 8)
    for row in (0, 1, -1, 99):
        with pytest.raises(Refused) as refused:
            gallery.picture(row, 8)
        assert refused.value.status == 404
    gallery.close()


def test_a_table_whose_pictures_are_gone_still_serves(table):
    gone = Gallery(FeatureTable(table.files, table.factors, origin={"data": "no-such-folder/x"}))
    assert "no-such-folder/x is not here" in gone.without_pictures
    with pytest.raises(Refused, match="name its place with --data"):
        gone.picture(0, 8)


def test_another_data_set_is_refused(table, tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "other.png")
    with pytest.raises(ValueError, match=r"holds none of the table's images, such as '0.png'"):
        Gallery(table, str(tmp_path))
    with pytest.raises(ValueError, match="is not here"):
        Gallery(table, str(tmp_path / "nowhere"))
