"""`--frame auto` (formerly `--crop`): a model is shown the part of an image that it knows."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from derender.data.synthetic import FaceSettings, faces
from derender.report.viewer.images import rendered_examples
from derender.scene.crop import Crop

KNOWN = "rendered-faces-64"
TRUE = Crop(0.7, 0.1, 0.2)


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """Two rendered faces: one as the model knows it, one small and off the middle of a wider image."""
    folder = tmp_path_factory.mktemp("framing")
    near, far = (example.picture for example in rendered_examples(KNOWN, 64)[2:4])
    Image.fromarray(near).save(folder / "near.png")
    left, top, side = TRUE.corner(200)
    coarse = np.random.default_rng(0).integers(0, 256, (6, 6, 3), dtype=np.uint8)
    wide = Image.fromarray(coarse).resize((200, 200), Image.Resampling.BICUBIC)
    wide.paste(Image.fromarray(far).resize((side, side), Image.Resampling.LANCZOS), (left, top))
    wide.save(folder / "wide.png")
    return folder


def test_the_part_is_found_told_and_drawn(photos, tmp_path, numbers):
    both = ("-m", KNOWN, photos / "near.png", photos / "wide.png", "-o")
    whole, printed = numbers("decompose", *both, tmp_path / "whole", "--frame", "none")
    assert "or another crop (derender align, --frame)" in printed
    result, printed = numbers("decompose", *both, tmp_path / "framed", "--crop", "auto")
    assert "shown in part, 70 % of their side: 1 of 2 images" in printed
    assert "1 of 2 images are reconstructed worse than 99 %" in printed  # chosen by that error: no acquittal
    near, wide = (result["framing"][str(photos / name)] for name in ("near.png", "wide.png"))
    assert (near["side"], near["across"], near["down"], near["found"]) == (1.0, 0.0, 0.0, "auto")
    assert {one["reconstruction_percentile"][str(photos / "wide.png")] for one in (whole, result)} == {100}
    shown = np.asarray(Image.open(tmp_path / "framed" / "wide" / "input.png").convert("RGB"), float)
    face = rendered_examples(KNOWN, 64)[3].picture
    assert Crop(wide["side"], wide["across"], wide["down"]) == TRUE
    assert np.abs(shown - face).mean() < 6
    beside = np.asarray(Image.open(tmp_path / "whole" / "near" / "input.png"))
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "framed" / "near" / "input.png")), beside)


def test_detail_films_and_meshes_are_of_the_same_part(photos, tmp_path, numbers):
    words = ("-m", KNOWN, photos / "wide.png", "--frame", "auto")
    words += ("--fit-steps", 0, "--texture", "original", "--size", 64, "-o")
    few = ["--stills", "2", "--film", "none", "--like", photos / "wide.png"]
    relit, _ = numbers("relight", *words, tmp_path / "relit", *few)
    meshes, _ = numbers("mesh", *words, tmp_path / "meshes")
    assert relit["framing"] == meshes["framing"]
    assert relit["framing"][str(photos / "wide.png")]["side"] < 1


def test_what_does_not_suit_the_model_is_drawn_only_with_force(photos, tmp_path, numbers, refused):
    blank = tmp_path / "blank.png"
    ramp = np.tile(np.linspace(0, 255, 200, dtype=np.uint8)[:, None, None], (1, 200, 3))
    Image.fromarray(ramp).save(blank)
    line = refused("relight", "-m", KNOWN, blank, "-o", tmp_path / "blank.jpg")
    assert "blank.png: no face is found" in line and "--force draws all" in line
    assert not (tmp_path / "blank.jpg").exists()
    both = ("decompose", "-m", KNOWN, tmp_path, "-o", tmp_path / "out")
    Image.open(photos / "near.png").save(tmp_path / "near.png")
    result, printed = numbers(*both)
    assert [Path(one["picture"]).name for one in result["pictures"]] == ["near.png"]
    assert result["refused"][str(blank)].startswith("no face is found; reconstructed worse than 100 % of")
    assert "left out" in printed and printed.count("--force draws all") == 1
    result, printed = numbers(*both, "--force")
    assert len(result["pictures"]) == 2 and result["framing"][str(blank)]["doubt"] == "no face is found"
    assert "drawn all the same: 1 image" in printed and not result["refused"]


def test_noise_is_left_out_though_its_grey_is_near_to_any(tmp_path, numbers, refused):
    noise = np.random.default_rng(0).integers(0, 256, (300, 300, 3), dtype=np.uint8)
    out = tmp_path / "lit.jpg"
    Image.fromarray(noise).save(tmp_path / "noise.png")
    words = ("relight", "-m", KNOWN, tmp_path / "noise.png", "-o", out, "--fit-steps", 0, "--size", 64)
    line = refused(*words)
    assert "no face is found; reconstructed worse than" in line and "fits better" not in line
    assert "with 0 % of its variance explained" in line and not out.exists()
    numbers(*words, "--force")
    assert out.exists()


def test_profiles_are_left_out_however_well_they_are_reconstructed(photos, tmp_path, numbers):
    view = {"yaw_deg": (70, 70), "yaw_sd_deg": None}
    settings = FaceSettings.model_validate({"view": view, "pictures_per_identity": 1})
    for name, seed in (("found.png", 1), ("missed.png", 3)):
        head = faces.generate(1, 256, seed, settings).images[0].transpose(1, 2, 0)
        Image.fromarray(np.pad(head, ((60, 60), (60, 60), (0, 0)), mode="edge")).save(tmp_path / name)
    Image.open(photos / "near.png").save(tmp_path / "near.png")
    result, _ = numbers("decompose", "-m", KNOWN, tmp_path, "-o", tmp_path / "out")
    assert [Path(one["picture"]).name for one in result["pictures"]] == ["near.png"]
    found, missed = (result["refused"][str(tmp_path / name)] for name in ("found.png", "missed.png"))
    assert found == "the face is turned by 73 degrees, models of faces know 60"
    assert missed.startswith("no face is found, perhaps a profile turned by 73 degrees (surest candidate: ")


def test_another_word_is_refused(photos, tmp_path, refused):
    words = ("rotate", "-m", KNOWN, photos / "near.png", "-o", tmp_path / "out", "--crop", "atuo")
    assert "unknown crop 'atuo'; did you mean 'auto'?" in refused(*words)
    assert not (tmp_path / "out").exists()
