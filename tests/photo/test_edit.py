"""A photograph in, a photograph out: any kind of image, faces found, edits where they belong."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tests.photo.test_align import scene

import derender
from derender.photo import Frame, find_faces, found_frame, open_photograph
from derender.photo.edit import FIT_STEPS
from derender.photo.faces import BOTH_FAMILIES, frame_of
from derender.postprocess import Features

MODULE = sys.modules["derender.photo.edit"]


@pytest.fixture(scope="module")
def model():
    return derender.load("rendered-faces-64")


@pytest.fixture(scope="module")
def photo() -> Image.Image:
    return with_head(0.0)


def with_head(roll: float) -> Image.Image:
    return scene((0, 256, (150, 80), roll)).resize((160, 120), Image.Resampling.LANCZOS)


def test_the_face_is_found_where_it_is_and_as_it_is_rolled(photo):
    (face,) = find_faces(np.asarray(photo))
    frame = frame_of(face, BOTH_FAMILIES)
    assert abs(frame.x - 69.5) < 6 and abs(frame.y - 52) < 6
    assert abs(frame.side - 64) < 12 and abs(frame.roll_deg) < 10
    for roll in (-20.0, 20.0):
        (face,) = find_faces(np.asarray(with_head(roll)))
        assert abs(frame_of(face, BOTH_FAMILIES).roll_deg - frame.roll_deg - roll) < 5


def test_frames_by_name(photo, model):
    pixels = np.asarray(photo)
    assert found_frame(pixels, model, "none") == (Frame.centred(160, 120), "none", "")
    assert found_frame(pixels, model)[1] == found_frame(pixels, model, "face")[1] == "face"
    empty = np.full((200, 300, 3), 128, np.uint8)
    assert found_frame(empty, model) == (Frame.centred(300, 200), "no face", "no face is found")
    with pytest.warns(UserWarning, match="no face is found; choose frame auto or none"):
        assert np.abs(derender.rotate(empty, model, yaw_deg=0).astype(int) - 128).max() <= 1
    assert found_frame(empty[:64, :64], model)[1] == "none"
    with pytest.raises(ValueError, match="no face is found"):
        found_frame(empty, model, "face")
    with pytest.raises(ValueError, match="did you mean 'face'"):
        found_frame(empty, model, "fase")


def test_why_a_photograph_does_not_suit_the_model(photo, model, monkeypatch):
    pixels = np.asarray(photo)
    face = find_faces(pixels)[0]

    def doubt(**changed: object) -> tuple[str, str]:
        monkeypatch.setattr(MODULE, "face_candidates", lambda _: [replace(face, **changed)])
        _, how, why = found_frame(pixels, model)
        return how, why

    assert doubt(yaw_deg=-64.0) == ("profile", "the face is turned by 64 degrees, models of faces know 60")
    assert doubt(yaw_deg=56.0) == ("face", "")
    rejected = "confidence 0.90 is below 0.95"
    assert doubt(rejected=rejected) == ("no face", f"no face is found (surest candidate: {rejected})")
    perhaps = f"no face is found, perhaps a profile turned by 70 degrees (surest candidate: {rejected})"
    assert doubt(yaw_deg=70.0, rejected=rejected) == ("profile", perhaps)


def test_edits_change_the_face_and_leave_the_rest(photo, model):
    before = np.asarray(photo).astype(int)
    for after in (derender.relight(photo, model, yaw_deg=-60), derender.rotate(photo, model, yaw_deg=20)):
        change = np.abs(np.asarray(after).astype(int) - before).max(axis=-1)
        assert change[37:67, 55:85].mean() > 3
        assert (change[:, 140:] == 0).all() and (change[110:] == 0).all()
    for same in (derender.rotate(photo, model, yaw_deg=0), derender.relight(photo, model, like=photo)):
        assert np.abs(np.asarray(same).astype(int) - before).max() <= 1


def test_what_the_border_cuts_off_leaves_no_streak_beside_it(model):
    photo = np.full((96, 96, 3), 120, np.uint8)
    photo[44:50, :8] = 250  # as an ear
    detail = open_photograph(photo, model, frame="none").detail.photo[0]
    assert float(detail[:, 36].max()) > 0.9 and 0 < float(detail[:, 0].max()) - 120 / 255 < 0.15


def test_scenes_are_optimised_before_they_are_edited_and_those_of_decompose(photo, model):
    pixels, steps = np.asarray(photo), (FIT_STEPS, 0, None)
    optimised, predicted, usual = (open_photograph(pixels, model, fit_steps=one).scene for one in steps)
    assert torch.equal(usual.light, optimised.light) and not torch.equal(usual.light, predicted.light)
    unable = model.with_features(Features(model.whitening))
    assert model.fitting is not None and unable.fitting is None
    assert torch.equal(open_photograph(pixels, unable).scene.light, predicted.light)
    with pytest.raises(ValueError, match="at least one image"):
        derender.decompose([], model)
    scenes = derender.decompose([photo, pixels[None]], model)
    assert len(scenes) == 2 and scenes.depth.shape[-1] == model.image_size
    torch.testing.assert_close(scenes[0].depth, predicted.depth)
    assert torch.equal(derender.decompose(photo, model, fit_steps=FIT_STEPS).light, optimised.light)


def test_every_kind_of_image_comes_back_as_it_came(photo, model, tmp_path):
    pixels, model = np.asarray(photo), model.with_features(Features(model.whitening))  # feed-forward: sooner
    wanted = np.asarray(derender.relight(photo, model))
    photo.save(tmp_path / "p.png")
    from_path = derender.relight(tmp_path / "p.png", model)
    assert isinstance(from_path, Image.Image) and (np.asarray(from_path) == wanted).all()
    assert (derender.relight(pixels, model) == wanted).all()
    floats = derender.relight(pixels[None] / 255, model)
    assert floats.shape == (1, *pixels.shape) and floats.dtype == np.float64
    assert np.abs(floats[0] * 255 - wanted).max() < 1e-6
    tensor = derender.relight(torch.from_numpy(pixels.transpose(2, 0, 1).copy()).float() / 255, model)
    assert tensor.shape == (3, *pixels.shape[:2])
    assert (tensor * 255 - torch.from_numpy(wanted.transpose(2, 0, 1).copy())).abs().max() < 1e-3
    coarse = derender.relight(torch.from_numpy(pixels / 255).bfloat16(), model)
    assert coarse.shape == pixels.shape and coarse.dtype == torch.bfloat16
    listed = derender.relight([photo, pixels], model)
    assert isinstance(listed[0], Image.Image) and (listed[1] == wanted).all()


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("image", np.full((80, 80, 3), 200.0), "divide by 255"),
        ("image", np.full((80, 80, 3), -0.5), "add 1 and halve"),
        ("image", np.zeros((80, 80, 4)), r"\(80, 80, 4\) is no image"),
        ("image", np.zeros((0, 80, 80, 3)), r"\(0, 80, 80, 3\) is no image"),
        ("image", np.zeros((80, 80, 3), np.int64), "int64"),
        ("image", np.full((80, 80, 3), np.nan), "not finite"),
        ("image", "no/such/file.jpg", "does not exist"),
        ("yaw_deg", 90.0, "yaw_deg must lie between"), ("pitch_deg", -91.0, "pitch_deg must lie between"),
        ("strength", -1.0, "strength must be 0 or more"), ("fit_steps", -1, "fit_steps must be 0 or more"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_the_remedy(name, value, words, photo, model):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        derender.relight(**{"image": photo, "model": model, name: value})
