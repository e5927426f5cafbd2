"""Pose, light, relighting and brightness against known scenes: exact on the truth, nothing on constants."""

import numpy as np
import pytest
import torch
from PIL import Image

from derender import Derenderer
from derender.data import ImageSet, read_images
from derender.data.layouts import rendered
from derender.data.synthetic import faces
from derender.evaluation import brightness, light, pose, relight
from derender.evaluation.angles import agreement, known_angles, read_columns
from derender.evaluation.bootstrap import once_and_resampled
from derender.evaluation.photometry import surfaces
from derender.scene import Scene

RNG = np.random.default_rng(0)
QUICK = {"resamples": 40}


def knowing(scenes: Scene, turn: float = 0.0) -> Derenderer:
    """A model that knows the scene of every image by its place in the set, turned about y."""
    model = Derenderer.from_preset("small", image_size=32, width=4, light_width=4, code_size=12).eval()
    state = {"at": 0}

    def decompose(images) -> Scene:
        result = scenes[state["at"] : state["at"] + len(images)]
        state["at"] = (state["at"] + len(images)) % len(scenes)
        return result.with_parameters(camera=result.camera + torch.tensor([0, turn, 0, 0, 0, 0.0]))

    model.decompose = decompose
    return model


@pytest.fixture(scope="module")
def made():
    return faces.generate(24, 32, 0)


@pytest.fixture
def scenes(made) -> Scene:
    camera, lit = torch.from_numpy(made.camera).float(), torch.from_numpy(made.light).float()
    return Scene(torch.ones(24, 32, 32), torch.full((24, 3, 32, 32), 0.5), lit, camera)


def pictures(made) -> ImageSet:
    labels = dict(zip((*rendered.CAMERA, *rendered.LIGHT), (*made.camera.T[:5], *made.light.T), strict=True))
    labels |= {"identity": made.identity}
    return ImageSet(made.images, tuple(f"a/{row}.png" for row in range(len(made.images))), labels)


def score(result, angle: str, row: str = "model") -> dict[str, float]:
    return {name: one["value"] for name, one in result.values[angle][row]["scores"].items()}


def test_agreement_is_that_of_numpy_also_on_resamples():
    true, weights = RNG.standard_normal(50), once_and_resampled(50, 2)
    predicted = 0.4 * true + 2 + 0.1 * RNG.standard_normal(50)
    result = agreement(predicted, true, weights)
    assert result["r"].value == pytest.approx(np.corrcoef(predicted, true)[0, 1])
    assert result["slope"].value == pytest.approx(np.polyfit(true, predicted, 1)[0])
    assert result["offset"].value == pytest.approx((predicted - true).mean())
    drawn = np.repeat(np.arange(50), weights[2].astype(int))
    expected = np.corrcoef(predicted[drawn], true[drawn])[0, 1]
    assert result["r"].resampled[1] == pytest.approx(expected)
    assert np.isnan(agreement(np.ones(50), true, weights)["r"].value)


def test_pose_is_exact_up_to_a_constant_turn(made, scenes, tmp_path):
    result = pose(knowing(scenes, 0.1), pictures(made), **QUICK)
    for angle, offset in (("yaw", np.degrees(0.1)), ("pitch", 0), ("roll", 0)):
        own = score(result, angle)
        assert (own["r"], own["slope"]) == (pytest.approx(1, abs=1e-4), pytest.approx(1, abs=1e-3))
        assert own["error"] == pytest.approx(0, abs=1e-3) and own["offset"] == pytest.approx(offset, abs=1e-3)
        assert score(result, angle, "constant answer")["slope"] == pytest.approx(0)
    names = np.array([f"elsewhere/{row}.png" for row in range(0, 24, 2)])
    columns = {"yaw": 1, "pitch": 0, "roll": 2}
    degrees = {name: np.degrees(made.camera[::2, column]) for name, column in columns.items()}
    np.savez(tmp_path / "judge.npz", name=names, **degrees)
    rows = zip(names, *degrees.values(), strict=True)
    lines = ["file,yaw,pitch,roll", *(",".join(map(str, row)) for row in rows)]
    (tmp_path / "judge.csv").write_text("\n".join(lines))
    for form in ("npz", "csv"):
        true, kept = known_angles(pictures(made), tmp_path / f"judge.{form}", dict.fromkeys(degrees, ""))
        np.testing.assert_allclose(true[:, 0], degrees["yaw"], rtol=1e-5)
        assert kept.files == pictures(made).files[::2]


def test_light_is_exact_in_the_frame_of_the_camera(made, scenes):
    result = light(knowing(scenes), pictures(made), **QUICK)
    for angle in ("azimuth", "elevation"):
        assert score(result, angle)["error"] == pytest.approx(0, abs=0.01)
        assert score(result, angle, "constant answer")["error"] > 5
    assert score(result, "direction")["all"] == pytest.approx(0, abs=0.01)


def test_a_wrong_table_is_named(tmp_path, made):
    np.savez(tmp_path / "few.npz", name=np.array(["x"]), yaw=np.array([1.0]))
    with pytest.raises(ValueError, match=r"unknown column of .*few\.npz 'pitch'"):
        read_columns(tmp_path / "few.npz", ("yaw", "pitch"))
    with pytest.raises(ValueError, match="names none of the images"):
        known_angles(pictures(made), tmp_path / "few.npz", {"yaw": ""})


def test_relighting_by_the_true_ratio_is_best(tmp_path):
    """Three flat grey people under three lights, one alone in another, named as Yale B."""
    Image.new("L", (84, 96), 80).save(tmp_path / "yaleB04_P00A+007E+00.png")
    for person, grey in enumerate((60, 90, 120)):
        for azimuth, gain in ((0, 1.0), (20, 0.75), (60, 0.5)):
            name = f"yaleB{person + 1:02d}_P00A{azimuth:+04d}E+00.png"
            noise = RNG.integers(-20, 20, (96, 84)) * (person + 1) / 3
            Image.fromarray(((grey + noise) * gain).clip(0, 255).astype(np.uint8)).save(tmp_path / name)
    model = Derenderer.from_preset("small", image_size=32, width=4, light_width=4, code_size=12).eval()
    result = relight(model, tmp_path, size=32, **QUICK)
    psnr = {name: row["scores"]["all"]["value"] for name, row in result.values["psnr"].items()}
    assert ", ".join(psnr) == "photograph relit, model's rendering, input, mean image, another person's ratio"
    assert psnr["another person's ratio"] > psnr["input"] + 3
    assert (result.values["pictures"], result.values["people"]) == (6, 3)
    assert [one.name for one in result.tables[0].columns if one.name != "95 %"] == ["all", "<= 25", "<= 77"]
    with pytest.raises(ValueError, match="has no label 'identity'"):
        relight(model, read_images(tmp_path, 32, dataset="folder"), size=32)


def test_brightness_of_the_true_albedo_has_slope_1(made, scenes):
    skin = np.linspace(0.2, 0.9, 24)
    albedo = torch.tensor(skin).float().view(-1, 1, 1, 1).expand(-1, 3, 32, 32)
    scenes = scenes.with_parameters(albedo=albedo, camera=torch.zeros(24, 6))
    seen = surfaces(knowing(scenes), made.images)
    np.testing.assert_allclose(seen["albedo"], np.repeat(skin[:, None], 3, axis=1), atol=1e-4)
    shading = scenes.light[:, 0] + scenes.light[:, 1] * scenes.light[:, 2].cos()
    assert (seen["light"] <= shading.numpy() + 0.6).all() and seen["light"].std() > 0.01
    groups = np.where(skin > 0.55, "light", "dark")
    images = (255 * np.broadcast_to(skin[:, None, None, None], made.images.shape)).astype(np.uint8)
    known = ImageSet(images, tuple(map(str, range(24))), {"race": groups})
    result = brightness(knowing(scenes), known, by="race", **QUICK)
    share = {name: row["scores"]["share"]["value"] for name, row in result.values["share"].items()}
    assert share["model"] == pytest.approx(1, abs=0.02) and abs(share["untrained model"]) < 0.3
    with pytest.raises(ValueError, match="an image set holds no true albedo"):
        brightness(knowing(scenes), known)
