"""Gloss, cast shadows, several lamps and haze of generated images, against their maps and their formulas."""

import numpy as np
import pytest
from PIL import Image

from derender.data.synthetic import CarSettings, FaceSettings, cars, faces, named_settings, write
from derender.data.synthetic.lighting import EFFECTS
from derender.data.synthetic.synthetic_set import camera_rotation_and_light
from derender.scene.camera import pixel_rays

SIDE = 48
LIGHT = {"yaw_deg": [30, 60], "pitch_deg": [-20, 20], "ambient": [0.1, 0.1], "diffuse": [0.5, 0.5]}
KINDS = {"gloss": {"gloss": [0.2, 0.4], "exponent": [8, 32]}, "shadows": {"shadows": True}}
KINDS |= {"lamps": {"lamps": 3}, "haze": {"haze": [0.5, 3], "airlight": [0.5, 0.9]}}


def made(kind: str | None, module=faces, settings=FaceSettings, count: int = 3):
    effects = {} if kind is None else KINDS[kind]
    given = settings.model_validate({"light": LIGHT, "effects": effects, "backgrounds": ["plain"]})
    return module.generate(count, SIDE, 0, given)


@pytest.fixture(scope="module")
def plain():
    return made(None)


@pytest.mark.parametrize("kind", KINDS)
def test_images_are_their_maps_put_together(kind, plain):
    """Inside smooth parts a pixel is its middle sample: albedo * shading + highlight, behind the haze."""
    with_effect = made(kind)
    assert tuple(with_effect.effects) == EFFECTS and not plain.effects
    for name in ("depth", "normal", "albedo", "mask", "light", "camera"):
        assert np.array_equal(getattr(with_effect, name), getattr(plain, name)), "only light changes"
    maps = {name: value[:, None] for name, value in with_effect.effects.items()}
    air = with_effect.labels["haze_airlight"][:, None, None, None] if kind == "haze" else 0.0
    lit = with_effect.albedo / 255 * maps["shading"] + maps["highlight"]
    expected = (lit * maps["transmission"] + air * (1 - maps["transmission"])).clip(0, 1)
    off = np.abs(with_effect.images / 255 - expected)[np.broadcast_to(plain.mask[:, None], expected.shape)]
    assert np.median(off) < 0.01 and np.percentile(off, 90) < 0.08


def test_maps_follow_their_formulas(plain):
    cosine = np.einsum("nhwc,nc->nhw", plain.normal, light_of(plain)).clip(0)
    strength = plain.light[:, 1, None, None]
    shadows, gloss, haze, lamps = (made(kind) for kind in ("shadows", "gloss", "haze", "lamps"))
    inside = plain.mask
    one_lamp = 0.1 + strength * cosine
    np.testing.assert_allclose(gloss.effects["shading"][inside], one_lamp[inside], atol=2e-3)
    shaded = 0.1 + strength * shadows.effects["visible"] * cosine
    np.testing.assert_allclose(shadows.effects["shading"][inside], shaded[inside], atol=2e-3)
    assert (lamps.effects["shading"] >= one_lamp - 2e-3)[inside].all()
    dark = (shadows.effects["visible"] < 0.5) & (cosine > 0.1) & inside
    assert 0.005 < dark.mean() < 0.3, "side light casts the nose's shadow"
    half = pixel_rays(SIDE, SIDE, 10.0).numpy()
    half = half / np.linalg.norm(half, axis=-1, keepdims=True) + light_of(plain)[:, None, None]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    force, exponent = (gloss.labels[f"gloss_{name}"][:, None, None] for name in ("strength", "exponent"))
    shine = force * strength * (plain.normal * half).sum(-1).clip(0) ** exponent * (cosine > 0)
    np.testing.assert_allclose(gloss.effects["highlight"][inside], shine[inside], atol=5e-3)
    for n in range(len(plain)):
        depth, own = plain.depth[n][inside[n]], haze.effects["transmission"][n][inside[n]]
        beta = float(haze.labels["haze_beta"][n])
        slope = np.polyfit(depth, np.log(own), 1)[0]  # samples reach a little farther than pixels
        assert slope * np.ptp(depth) == pytest.approx(-beta, rel=0.1)


def light_of(made) -> np.ndarray:
    return camera_rotation_and_light(made.camera, made.light)[1].astype(np.float32)


def test_cars_cast_shadows_too():
    result = made("shadows", cars, CarSettings, 2)
    assert ((result.effects["visible"] < 0.5) & result.mask).any()
    assert ((result.effects["visible"] > 0.99) & result.mask).mean() > 0.05


def test_settings_are_named_and_bounded_and_maps_are_written(tmp_path):
    given = named_settings(FaceSettings, overrides=["effects.gloss=[0.1,0.5]", "effects.shadows=true"])
    assert given.effects.any and given.effects.gloss == (0.1, 0.5)
    with pytest.raises(ValueError, match=r"gloss': must be two numbers, low <= high, within 0..0.5"):
        named_settings(FaceSettings, overrides=["effects.gloss=[0,2]"])
    with pytest.raises(ValueError, match=r"effects\.lamps"):
        named_settings(FaceSettings, overrides=["effects.lamps=9"])
    hazy = made("haze", count=2)
    folder = write(hazy, tmp_path / "set")
    read = np.asarray(Image.open(folder / "transmission" / "000001.png")).astype(float) / 65535 * 2
    np.testing.assert_allclose(read, hazy.effects["transmission"][1], atol=2e-5)
    assert "haze_beta" in (folder / "params.csv").read_text().splitlines()[0]
