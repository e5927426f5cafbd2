"""Laws of generated faces and cars: the same bytes for a seed, and truth that explains the image."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from derender.data.synthetic import CAR_VIEWS, VIEWS, CarSettings, FaceSettings, cars, faces
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.scene.camera import project, to_canonical, unproject
from derender.scene.normals import normals_from_depth

MAPS = ("images", "depth", "normal", "albedo", "mask", "parts", "light", "camera", "identity")


@dataclass(frozen=True)
class Kind:
    """A generator with the errors measured of it, and the fingerprint of seed 3."""

    generate: Callable[..., SyntheticSet]
    settings: type
    shading: tuple[float, float, float]  # grey levels: most of the median, a percentile and its value
    normals_deg: float
    means: tuple[float, ...]  # of image, depth, normal, albedo, mask, parts


MEANS = {
    "faces": (119.4513, 0.6596005, 0.1658467, 100.6857, 0.6686198, 2.666097),
    "cars": (105.7537, 0.3022099, 0.1096342, 19.99224, 0.3092448, 0.5977376),
}
KINDS = {
    "faces": Kind(faces.generate, FaceSettings, (1.0, 90, 8.0), 2.0, MEANS["faces"]),
    "cars": Kind(cars.generate, CarSettings, (0.6, 80, 8.0), 5.0, MEANS["cars"]),
}

TURNED = [
    (faces.generate, FaceSettings(expressions=("neutral",), asymmetry=0.0, gaze_px=0.0), VIEWS, 1e-3),
    (cars.generate, CarSettings(classes=("sedan", "van", "suv"), pictures_per_model=1), CAR_VIEWS, 8e-4),
]


@pytest.fixture(scope="module", params=KINDS)
def kind(request) -> Kind:
    return KINDS[request.param]


@pytest.fixture(scope="module")
def sample(kind) -> SyntheticSet:
    return kind.generate(24, seed=3)


def digest(made: SyntheticSet, rows: slice = slice(None)) -> str:
    arrays = [getattr(made, name) for name in MAPS]
    columns = [*arrays, *made.labels.values(), *made.identity_traits.values()]
    return hashlib.sha256(b"".join(values[rows].tobytes() for values in columns)).hexdigest()


def inner(mask: np.ndarray, pixels: int = 1) -> np.ndarray:
    return np.stack([binary_erosion(m, iterations=pixels) for m in mask])


def test_same_seed_same_bytes_on_any_number_of_threads(kind, sample):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert digest(kind.generate(24, seed=3)) == digest(sample)
    finally:
        torch.set_num_threads(before)
    assert (sample.images != kind.generate(24, seed=4).images).any(axis=(1, 2, 3)).all()


def test_an_image_depends_on_seed_and_index_alone(kind, sample):
    short, later = kind.generate(5, seed=3), kind.generate(7, seed=3, first=13)
    for name in (*MAPS, "labels"):
        whole, start, end = (getattr(made, name) for made in (sample, short, later))
        for key in whole if name == "labels" else [...]:
            assert (whole[key][:5] == start[key]).all() and (whole[key][13:20] == end[key]).all(), (name, key)


def test_images_are_those_of_former_releases(kind):
    """Means of every map; bytes would differ between processors."""
    made = kind.generate(12, 32, seed=3)
    means = [getattr(made, name).astype(float).mean() for name in MAPS[:6]]
    assert means == pytest.approx(kind.means, rel=2e-4), means


def shading_error(made: SyntheticSet, light: np.ndarray) -> np.ndarray:
    _, direction = camera_rotation_and_light(made.camera, light)
    cosine = np.maximum(0.0, np.einsum("nhwk,nk->nhw", made.normal, direction))
    shading = light[:, 0, None, None] + light[:, 1, None, None] * cosine
    again = np.clip(made.albedo / 255.0 * shading[:, None], 0.0, 1.0) * 255.0
    return np.abs(again - made.images).mean(axis=1)[inner(made.mask)]


def test_shading_the_truth_again_gives_the_image_and_with_a_wrong_light_does_not(kind, sample):
    error = shading_error(sample, sample.light)
    median, share, limit = kind.shading  # rounding of image and albedo included; samples of two colours mix
    assert np.median(error) < median and np.percentile(error, share) < limit
    assert np.median(shading_error(sample, sample.light * np.array([1, 1, -1, -1], np.float32))) > 5.0


def test_normals_are_those_of_the_depth_map(kind, sample):
    seen = normals_from_depth(torch.from_numpy(sample.depth), sample.fov_deg).numpy()
    cosine = np.clip((seen * sample.normal).sum(axis=-1), -1, 1)[inner(sample.mask, 2)]
    assert np.median(np.rad2deg(np.arccos(cosine))) < kind.normals_deg
    length = np.linalg.norm(sample.normal, axis=-1)
    assert np.allclose(length[sample.mask], 1.0, atol=1e-5) and not length[~sample.mask].any()


@pytest.mark.parametrize(("generate", "settings", "views", "closer"), TURNED, ids=KINDS)
def test_unprojected_points_lie_on_the_canonical_surface(generate, settings, views, closer):
    """The same objects from ahead and turned: points turned back land on the frontal depth map."""
    turned = generate(4, seed=5, settings=settings)
    ahead = generate(4, seed=5, settings=settings.model_copy(update={"view": views["frontal"]}))
    assert np.abs(turned.camera).max() > 0.1 and np.abs(ahead.camera).max() < 1e-6
    for n in range(4):
        assert np.median(distance(turned, ahead, n, turned.camera[n])) < closer
        assert np.median(distance(turned, ahead, n, -turned.camera[n])) > 3e-3


def distance(turned: SyntheticSet, ahead: SyntheticSet, n: int, camera: np.ndarray) -> np.ndarray:
    """Distance along z of image n's points, taken back by ``camera``, from the surface seen from ahead."""
    seen = unproject(torch.from_numpy(turned.depth[n : n + 1]), turned.fov_deg)
    points = to_canonical(seen, torch.from_numpy(camera[None]))[0][torch.from_numpy(turned.mask[n])]
    column, row = project(points, 64, 64, turned.fov_deg).round().int().clamp(0, 63).numpy().T
    covered = ahead.mask[n][row, column]
    assert covered.sum() > 400
    return np.abs(ahead.depth[n][row, column] - points[:, 2].numpy())[covered]


def test_maps_agree_on_where_the_object_is(sample):
    assert ((sample.parts > 0) == sample.mask).all() and ((sample.depth > 0) == sample.mask).all()
    assert not sample.albedo.transpose(0, 2, 3, 1)[~sample.mask].any()


@pytest.mark.parametrize("size", [32, 48, 128])
def test_other_sizes_show_the_same_object(kind, sample, size):
    made = kind.generate(2, size, seed=3)
    assert made.images.shape == (2, 3, size, size)
    if kind.settings is FaceSettings:  # a car's middle may lie beside an edge
        middle = made.depth[:, size // 2, size // 2]
        assert np.allclose(middle, sample.depth[:2, 32, 32], atol=6e-3)
    assert np.allclose(made.images.mean(axis=(2, 3)), sample.images[:2].mean(axis=(2, 3)), atol=6.0)
    assert np.allclose(made.mask.mean(axis=(1, 2)), sample.mask[:2].mean(axis=(1, 2)), atol=0.03)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count must be 1 or more"),
        ({"count": 2, "image_size": 8}, "image_size must be 16..1024"),
        ({"count": 2, "seed": -1}, "seed and first must be 0 or more"),
    ],
)
def test_bad_arguments_are_named(kind, arguments, message):
    with pytest.raises(ValueError, match=message):
        kind.generate(**arguments)


@pytest.mark.parametrize(
    ("kind_of", "setting", "message"),
    [
        (FaceSettings, {"light": {"ambient": (0.7, 0.2)}}, "(?s)ambient.*must be two numbers.* within 0..1"),
        (FaceSettings, {"view": {"yaw_beyond_deg": 50}}, "(?s)yaw_beyond_deg.*must lie within"),
        (FaceSettings, {"expressions": ("smug",)}, "(?s)expressions.*must be one or more of neutral"),
        (FaceSettings, {"expressions": ()}, "must be one or more"),
        (FaceSettings, {"expressions": {"fear": 0.0}}, "shares must be 0 or more and not all 0"),
        (FaceSettings, {"backgrounds": ("beach",)}, "(?s)backgrounds.*must be"),
        (FaceSettings, {"pictures_per_identity": 0}, "pictures_per_identity"),
        (FaceSettings, {"age_years": (10, 40)}, "(?s)age_years.*must be two numbers"),
        (FaceSettings, {"yaw": 3}, "yaw"),
        (CarSettings, {"view": {"elevation_deg": (-5, 40)}}, r"(?s)view.elevation_deg.*must be two.*0..90"),
        (CarSettings, {"view": {"azimuth_beyond_deg": 40}}, "(?s)azimuth_beyond_deg.*must lie within"),
        (CarSettings, {"size": 0.5}, "size"),
    ],
)
def test_bad_settings_are_named(kind_of, setting, message):
    with pytest.raises(ValueError, match=message):
        kind_of(**setting)
