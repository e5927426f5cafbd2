"""Images come in, answers come out, and nothing but the page's own files is ever served."""

import io
import json
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from tests.report.viewer.serving import serving

from derender import Derenderer, load
from derender.data.synthetic import faces
from derender.report.viewer.app import Application
from derender.report.viewer.images import rendered_examples
from derender.report.viewer.questions import Camera, CropRequest, Light, Place, ViewRequest
from derender.report.viewer.studio import Shelf, Studio
from derender.scene.crop import Crop
from derender.scene.ranges import SceneRanges
from derender.storage.places import model_folder
from derender.training.held_out_errors import read_errors

LIGHT = {"ambient": 0.3, "diffuse": 0.7, "pitch_deg": 0.0, "yaw_deg": 0.0}
FRONT = {"rotation_deg": [0, 0, 0], "translation": [0, 0, 0]}


def test_about_says_what_there_is_and_a_picture_is_taken_apart_and_shown(client):
    about = client.get("/api/about").json
    assert about["model"] == "<b>tiny</b>"
    assert not about["faces"] and not about["can_fit"]
    assert [example["name"] for example in about["examples"]] == ["<img src=x>"]
    assert about["table"] is None
    result = client.opened(0)
    assert (result["width"], result["height"], result["framed"], result["faces"]) == (48, 40, "none", [])
    assert result["crop"] == {"x": 24, "y": 20, "side": 40, "roll_deg": 0}
    assert 0 < result["l1"] < 1 and result["percentile"] is None and result["out_of_distribution"] is False
    assert result["l1_feed_forward"] is None
    own = client.post("/api/view", {"picture": result["picture"]})
    assert (own.status, own.headers["content-type"]) == (200, "image/jpeg")
    assert own.image.shape == (27, 32, 4)  # the part around the crop: here all of the photograph
    before = client.post("/api/before", {"picture": result["picture"]}).image
    assert np.abs(own.image.astype(int) - before).mean() < 2  # its own light and view give it back
    again = client.post("/api/view", {key: result[key] for key in ("picture", "light", "camera")})
    assert np.abs(again.image.astype(int) - own.image).max() <= 4  # degrees and back, as JPEG


def test_a_fitted_scene_is_nearer_to_the_picture():
    model, face = load("rendered-faces-64"), faces.generate(1, 64, seed=7).images[0]
    held_out = read_errors(model_folder("rendered-faces-64"))
    studios = (Studio(model, "faces", held_out=held_out, fit_steps=steps) for steps in (0, 10))
    read, fitted = (studio.open(face.transpose(1, 2, 0)) for studio in studios)
    assert fitted["l1_feed_forward"] == pytest.approx(read["l1"])
    assert fitted["l1"] < 0.9 * read["l1"]
    assert fitted["percentile"] == read["percentile"] is not None  # of the feed-forward scene
    assert fitted["light"] != read["light"] and fitted["camera"] != read["camera"]


def test_light_and_camera_move(client):
    name = client.opened(0)["picture"]

    def shown(light: dict, camera: dict | None = None) -> np.ndarray:
        asked = {"picture": name, "light": {**LIGHT, **light}, "camera": camera or FRONT, "detail": "model"}
        return client.post("/api/view", asked).image.astype(float)

    dark, bright = shown({"diffuse": 0.0, "ambient": 0.1}), shown({"diffuse": 0.0, "ambient": 1.0})
    assert dark[..., :3].mean() < 0.3 * bright[..., :3].mean()
    lit = ({"picture": name, "light": {**LIGHT, "yaw_deg": yaw}} for yaw in (60.0, -60.0))
    left, right = (client.post("/api/view", asked).image for asked in lit)
    assert not np.array_equal(left, right)
    moved = shown({}, {"rotation_deg": [0, 0, 0], "translation": [0.05, 0, 0]})
    assert (moved[:, :8, 3] == 0).all() and (shown({})[..., 3] == 255).all()


def test_factors_of_another_picture(client):
    one, two = client.opened(1), client.opened(2)
    asked = {"picture": one["picture"], "light": LIGHT, "camera": FRONT}
    swapped = {**asked, "swaps": {"geometry": two["picture"], "albedo": two["picture"]}}
    whole = client.post("/api/picture", {**asked, "picture": two["picture"]})
    assert np.array_equal(client.post("/api/picture", swapped).image, whole.image)
    maps, other = (client.post("/api/factors", question).json for question in (asked, swapped))
    assert list(maps) == ["input", "reconstruction", "depth", "normals", "albedo", "shading"]
    changed = {name for name in maps if maps[name] != other[name]}
    assert {"albedo", "depth", "normals"} <= changed and not changed & {"input", "reconstruction"}


def test_exports_hold_what_they_promise(client):
    asked = {"picture": client.opened(3)["picture"], "light": LIGHT, "camera": FRONT, "size": 64}
    assert client.post("/api/picture", asked).image.shape == (40, 48, 4)  # the photograph's own size
    drawn = client.post("/api/picture", {**asked, "detail": "model"}).image
    assert drawn.shape == (64, 64, 4)
    film = client.post("/api/film", {**asked, "kind": "gif", "move": "light"})
    with Image.open(io.BytesIO(film.body)) as frames:
        assert (frames.format, frames.n_frames) == ("GIF", 24)
    film = client.post("/api/film", {**asked, "kind": "mp4", "move": "camera"})
    assert film.headers["content-type"] == "video/mp4" and film.body[4:8] == b"ftyp"
    assert client.post("/api/panel", asked).image.shape[1] > 800
    settings = client.post("/api/settings", asked).json
    assert settings["light"] == LIGHT and settings["camera"] == FRONT and settings["size"] == 64
    mesh = trimesh.load(io.BytesIO(client.post("/api/mesh", asked).body), file_type="glb", force="mesh")
    assert len(mesh.faces) > 100
    with zipfile.ZipFile(io.BytesIO(client.post("/api/archive", asked).body)) as archive:
        assert archive.testzip() is None
        assert {"panel.png", "albedo.png", "surface.glb", "settings.json"} <= set(archive.namelist())
        assert json.loads(archive.read("settings.json")) == settings


@pytest.mark.parametrize(
    "path",
    [
        "/etc/passwd", "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/page/index.html",
        "/view.js/../../app.py", "/app.py", "/view.js%00.png", "/api/examples/../../etc/passwd",
        "/file=/etc/passwd",
    ],
)  # fmt: skip
def test_no_path_is_served(client, path):
    for method in ("GET", "POST"):
        reply = client(method, path)
        assert reply.status in (400, 404, 405)
        assert b"root:" not in reply.body and b"import" not in reply.body


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({}, "picture"), ({"picture": "../../../../etc/passwd"}, "pattern"),
        ({"picture": "a" * 22, "file": "/etc/passwd"}, "file"),
        ({"picture": "a" * 22, "size": 100_000}, "size"), ({"picture": "a" * 22, "size": "64"}, "size"),
        ({"picture": "a" * 22, "swaps": {"pose": "a" * 22}}, "swaps"),
        ({"picture": "a" * 22, "light": {**LIGHT, "yaw_deg": 1e9}}, "yaw_deg"),
        ({"picture": "a" * 22, "light": {**LIGHT, "ambient": float("nan")}}, "ambient"),
        ({"picture": "a" * 22, "camera": {**FRONT, "translation": [0, 0]}}, "translation"),
    ],
)  # fmt: skip
def test_a_question_that_makes_no_sense_is_told_so(client, asked, words):
    reply = client.post("/api/view", asked)
    assert reply.status == 422
    assert words in reply.error


def test_bodies_that_are_no_question(client):
    for body in (b"", b"[]", b"{", b"\xff\xfe", b"[" * 5000):
        assert client.post("/api/view", body).status == 422
    assert client.post("/api/view", b" " * 20_000).status == 413


def test_pictures_that_are_not_there(client):
    reply = client.post("/api/view", {"picture": "a" * 22})
    assert (reply.status, "open it again" in reply.error) == (410, True)
    assert client.post("/api/examples/7").status == 404
    assert client.post("/api/rows/0").status == 404
    first = client.opened(0)["picture"]
    assert client.post("/api/neighbours", {"picture": first, "factor": "albedo"}).status == 404
    for seed in range(4):
        client.opened(seed)
    assert client.post("/api/view", {"picture": first}).status == 410


def test_several_visitors_at_once_get_their_own_answers(client):
    names = [client.opened(seed)["picture"] for seed in range(4)]
    alone = [client.post("/api/view", {"picture": name}).body for name in names]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda name: client.post("/api/view", {"picture": name}).body, names * 5))
    assert together == alone * 5


def test_too_much_work_is_refused_not_queued_for_ever(model, picture, client):
    application = Application(Studio(model, "tiny", Shelf(2)), work_seconds=0.2)
    asked = {"picture": application.studio.open(picture)["picture"]}
    application._computing.submit(time.sleep, 1.0)
    with serving(application) as url:
        reply = type(client)(url).post("/api/view", asked)
        assert (reply.status, "too long" in reply.error) == (503, True)
        assert type(client)(url).opened()  # fits scenes, and compiles at its first time: it may take longer


def test_a_wider_picture_is_shown_in_the_part_that_the_model_knows():
    model, face = load("rendered-faces-64"), rendered_examples("rendered-faces-64", 64)[3].picture
    model = model.with_features(model.features.with_steps(0))
    wide = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
    left, top, side = Crop(0.5, 0.0, 0.2).corner(128)
    wide[top : top + side, left : left + side] = face
    framed, whole = Studio(model, "faces", frame="auto"), Studio(model, "faces")
    result = framed.open(wide)
    crop = {"x": left + side / 2, "y": top + side / 2, "side": side, "roll_deg": 0}
    assert result["crop"] == crop
    np.testing.assert_array_equal(framed.shelf.get(result["picture"]).pixels, face.transpose(2, 0, 1))
    assert result["l1"] == pytest.approx(whole.open(face)["l1"])
    assert framed.open(face)["crop"]["side"] == 64  # of the model's own size: as it is

    own = whole.again(CropRequest(picture=whole.open(wide)["picture"], crop=Place(**crop)))
    assert (own["framed"], own["l1"]) == ("own", result["l1"])
    beyond = whole.again(CropRequest(picture=own["picture"], crop=Place(x=1e6, y=1e6, side=1e7)))
    assert beyond["crop"]["side"] <= 256 and beyond["crop"]["x"] <= 128


def test_every_face_is_offered_and_the_largest_is_taken():
    photo = np.full((300, 560, 3), 128, np.uint8)
    large = rendered_examples("faces-64", 256)[0].picture
    photo[22:278, 280:536] = large
    photo[80:208, 60:188] = large[::2, ::2]
    studio = Studio(load("faces-64"), "faces")
    result = studio.open(photo)
    assert result["framed"] == "face" and len(result["faces"]) == 2
    assert result["crop"] == result["faces"][0] and result["crop"]["x"] > 280 > result["faces"][1]["x"]
    asked = ViewRequest(picture=result["picture"], light=Light(**LIGHT | {"yaw_deg": 60.0}))
    edited = np.asarray(Image.open(io.BytesIO(studio.picture(asked))))
    changed = np.abs(edited.astype(int) - photo).max(axis=-1) > 8
    assert edited.shape == photo.shape and changed[:, 280:].mean() > 0.2 and not changed[:, :150].any()


@pytest.mark.parametrize("renderer", ["phong+haze", "sh"])
def test_further_factors_move_and_swap(renderer):
    model = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4, renderer=renderer)
    studio, noise = Studio(model.eval(), "tiny"), np.random.default_rng(0)
    one, two = (studio.open(noise.integers(0, 256, (48, 48, 3), dtype=np.uint8)) for _ in range(2))
    about, asked = studio.about(), ViewRequest(picture=one["picture"])
    with pytest.raises(ValueError, match="cannot optimise scenes per image"):
        studio.again(CropRequest(picture=one["picture"], fit=True))
    maps = studio.maps(asked)
    assert set(about["maps"]) < set(maps) and zipfile.is_zipfile(io.BytesIO(studio.archive(asked)))
    if renderer == "sh":
        assert about["light"] is False and about["numbers"] == {}
        lit = asked.model_copy(update={"swaps": {"light": two["picture"]}})
        wanted = studio.shelf.get(two["picture"]).scene
        assert torch.equal(studio.scene(lit).extra["environment"], wanted.extra["environment"])
        assert Light.of(studio.scene(lit).light[0]).model_dump() == two["light"]
        return
    assert about["light"] and [one["name"] for one in about["numbers"]["haze"]] == ["beta", "airlight"]
    assert json.loads(studio.settings(asked))["numbers"] == one["numbers"]
    moved = asked.model_copy(update={"numbers": {**one["numbers"], "haze": [4.0, 1.0]}, "detail": "model"})
    own = asked.model_copy(update={"detail": "model"})
    change = np.asarray(studio._drawn(moved)).astype(float) - np.asarray(studio._drawn(own))
    assert change[..., :3].mean() > 5  # paler
    for numbers, message in (
        ({"haze": [9.0, 1.0]}, r"haze beta must lie in 0\.2\.\.4 for the renderer 'phong\+haze', got 9"),
        ({"haze": [1.0]}, r"haze must be \(N, 2\): beta, airlight"),
        ({"glow": [1.0]}, "this model has no 'glow'; it has specular, haze"),
    ):
        for answer in (studio.view, studio.settings):
            with pytest.raises(ValueError, match=message):
                answer(asked.model_copy(update={"numbers": numbers}))


def test_a_model_of_wider_ranges_than_the_page_has_opens_at_its_bounds():
    ranges = SceneRanges(ambient=(3, 4), light_deg=89.9, rotation_deg=89.9, translation_xy=1e6)
    settings = Derenderer.from_preset("small").settings.model_copy(update={"ranges": ranges})
    model = Derenderer.seeded(settings, 0)
    for name in ("light", "camera"):
        model.nets[name].decoder.linear.weight.data *= 1e4
    studio = Studio(model.eval().requires_grad_(False), "wide")
    result = studio.open(np.full((64, 64, 3), 99, np.uint8))
    assert result["light"]["ambient"] == 2 and abs(result["light"]["yaw_deg"]) == 89
    assert {abs(one) for one in result["camera"]["rotation_deg"]} == {89}
    assert studio.view(ViewRequest(**{name: result[name] for name in ("picture", "light", "camera")}))
    assert Light.of(torch.tensor([torch.nan, -1, 0, torch.nan])).ambient == 0
    for one in (studio, Studio(load("faces-64"), "faces-64")):  # the ends of all sliders are accepted
        Camera(rotation_deg=[0, 0, 0], translation=one.about()["translation"])
    assert Camera.of(torch.tensor([0, 0, 0, 0, 0, 0.77])).translation[2] == pytest.approx(0.77)
