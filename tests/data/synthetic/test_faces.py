"""Procedural faces: reproducible to the byte, and every truth map explains its picture."""

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from derender.data.synthetic import FaceSettings, faces
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.scene.camera import to_canonical, unproject
from derender.scene.normals import normals_from_depth

FRONTAL = {"yaw_sd_deg": 0.0, "pitch_sd_deg": 0.0, "roll_sd_deg": 0.0, "translation_sd": 0.0}
STILL = {"expressions": ("neutral",), "asymmetry": 0.0, "gaze_px": 0.0}
EVEN_LIGHT = {
    "light_pitch_deg": (0.0, 0.0),
    "light_yaw_deg": (0.0, 0.0),
    "ambient": (0.6, 0.6),
    "diffuse": (0.3, 0.3),
}


@pytest.fixture(scope="module")
def sample() -> SyntheticSet:
    return faces.generate(24, seed=3)


def inner(mask: np.ndarray, pixels: int = 1) -> np.ndarray:
    return np.stack([binary_erosion(m, iterations=pixels) for m in mask])


def test_same_seed_same_bytes_and_another_seed_other_faces(sample):
    again, other = faces.generate(24, seed=3), faces.generate(24, seed=4)
    for name in ("images", "depth", "normal", "albedo", "mask", "light", "camera", "identity", "strength"):
        assert getattr(sample, name).tobytes() == getattr(again, name).tobytes(), name
    assert (sample.images != other.images).any(axis=(1, 2, 3)).all()


def test_a_picture_depends_on_seed_and_index_alone(sample):
    short, later = faces.generate(5, seed=3), faces.generate(7, seed=3, first=13)
    for name in ("images", "depth", "normal", "albedo", "mask", "light", "camera", "identity", "expression"):
        assert getattr(short, name).tobytes() == getattr(sample, name)[:5].tobytes(), name
        assert getattr(later, name).tobytes() == getattr(sample, name)[13:20].tobytes(), name


def test_one_thread_and_many_make_the_same_bytes(sample):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert faces.generate(24, seed=3).images.tobytes() == sample.images.tobytes()
    finally:
        torch.set_num_threads(threads)


def test_shading_the_truth_again_gives_the_picture(sample):
    _, direction = camera_rotation_and_light(sample.camera, sample.light)
    cosine = np.maximum(0.0, np.einsum("nhwk,nk->nhw", sample.normal, direction))
    shading = sample.light[:, 0, None, None] + sample.light[:, 1, None, None] * cosine
    again = np.clip(sample.albedo / 255.0 * shading[:, None], 0.0, 1.0) * 255.0
    error = np.abs(again - sample.images).mean(axis=1)[inner(sample.mask)]
    assert np.median(error) < 1.0  # grey levels; measured 0.5, rounding of picture and albedo included
    assert np.percentile(error, 90) < 8.0


def test_shading_with_a_wrong_light_does_not(sample):
    _, direction = camera_rotation_and_light(
        sample.camera, sample.light * np.array([1, 1, -1, -1], np.float32)
    )
    cosine = np.maximum(0.0, np.einsum("nhwk,nk->nhw", sample.normal, direction))
    shading = sample.light[:, 0, None, None] + sample.light[:, 1, None, None] * cosine
    again = np.clip(sample.albedo / 255.0 * shading[:, None], 0.0, 1.0) * 255.0
    assert np.median(np.abs(again - sample.images).mean(axis=1)[inner(sample.mask)]) > 5.0


def test_normals_are_those_of_the_depth_map(sample):
    seen = normals_from_depth(torch.from_numpy(sample.depth), sample.fov_deg).numpy()
    cosine = np.clip((seen * sample.normal).sum(axis=-1), -1, 1)[inner(sample.mask, 2)]
    assert np.median(np.rad2deg(np.arccos(cosine))) < 2.0
    length = np.linalg.norm(sample.normal, axis=-1)
    assert np.allclose(length[sample.mask], 1.0, atol=1e-5)
    assert not length[~sample.mask].any()


def test_depth_lies_in_the_stated_range_and_fills_the_picture(sample):
    seen = sample.depth[sample.mask]
    assert seen.min() > 0.9 and seen.max() < 1.16
    assert not sample.depth[~sample.mask].any()
    assert 0.45 < sample.mask.mean(axis=(1, 2)).mean() < 0.95


def test_unprojected_points_lie_on_the_canonical_surface():
    """The same people seen frontally and turned: turned-back points land on the frontal depth map."""
    turned = faces.generate(4, seed=5, settings=FaceSettings(**STILL))
    frontal = faces.generate(4, seed=5, settings=FaceSettings(**STILL, **FRONTAL))
    assert np.abs(turned.camera).max() > 0.1 and not frontal.camera.any()
    for n in range(4):
        error = distance_to_frontal(turned, frontal, n, turned.camera[n])
        assert len(error) > 500
        assert np.median(error) < 1.0e-3  # measured 4e-4, rounding to the nearest pixel included
        assert np.percentile(error, 95) < 3.0e-3  # a few neck points are hidden under the frontal jaw
        assert np.median(distance_to_frontal(turned, frontal, n, -turned.camera[n])) > 3.0e-3


def distance_to_frontal(
    turned: SyntheticSet, frontal: SyntheticSet, n: int, camera: np.ndarray
) -> np.ndarray:
    """Distance along z of picture n's points, taken back by ``camera``, from the frontal surface."""
    seen = unproject(torch.from_numpy(turned.depth[n : n + 1]), turned.fov_deg)
    points = to_canonical(seen, torch.from_numpy(camera[None]))[0].numpy()
    x, y, z = points[turned.mask[n]].T
    focal = 31.5 / np.tan(np.deg2rad(5.0))
    column, row = np.rint(x / z * focal + 31.5).astype(int), np.rint(y / z * focal + 31.5).astype(int)
    inside = (abs(column - 31.5) < 16) & (row > 8) & (row < 52)
    return np.abs(frontal.depth[n][row[inside], column[inside]] - z[inside])


def test_neutral_surfaces_are_symmetric_with_the_nose_tip_in_place():
    still = faces.generate(16, seed=6, settings=FaceSettings(**STILL, **FRONTAL, pictures_per_identity=1))
    both = still.mask & still.mask[..., ::-1]
    apart = np.abs(still.depth - still.depth[..., ::-1])[inner(both, 3)]
    assert np.percentile(apart, 99) < 5e-4 and np.median(apart) < 2e-5
    tip = still.depth[:, 24:42, 26:38].min(axis=(1, 2))
    assert np.allclose(tip, faces.NOSE_TIP_Z, atol=1.5e-3)


def test_people_differ_and_pictures_of_one_person_agree_without_light():
    settings = FaceSettings(**STILL, **FRONTAL, pictures_per_identity=2)
    people = faces.generate(24, seed=7, settings=settings)
    assert (people.albedo[::2] == people.albedo[1::2]).all()
    assert (people.depth[::2] == people.depth[1::2]).all()
    assert (people.images[::2] != people.images[1::2]).any(axis=(1, 2, 3)).all()
    first = people.albedo[::2].astype(float)
    between = np.abs(first[:, None] - first[None]).mean(axis=(2, 3, 4))
    assert between[~np.eye(12, dtype=bool)].min() > 4.0
    shape = people.depth[::2, 16:56, 16:48]
    apart = np.abs(shape[:, None] - shape[None]).mean(axis=(2, 3))
    assert apart[~np.eye(12, dtype=bool)].min() > 5e-4
    traits = people.identity_traits
    assert all((values[::2] == values[1::2]).all() for values in traits.values())
    assert len(set(traits["shape_nose_length"].tolist())) == 12


def test_each_expression_changes_the_face_in_its_own_way():
    common = {**FRONTAL, **EVEN_LIGHT, "strength": (1.0, 1.0), "asymmetry": 0.0, "gaze_px": 0.0}
    shown = {
        name: faces.generate(3, seed=8, settings=FaceSettings(**common, expressions=(name,))).depth[
            :, 8:56, 14:50
        ]
        for name in FaceSettings().expressions
    }
    names = list(shown)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            assert np.abs(shown[a] - shown[b]).max(axis=(1, 2)).min() > 2e-3, (a, b)


def test_settings_are_respected():
    settings = FaceSettings(
        yaw_mean_deg=30, yaw_sd_deg=5, yaw_limit_deg=8, light_yaw_deg=(50, 70), ambient=(0.1, 0.2),
        diffuse=(0.9, 1.0), expressions=("happy", "fear"), pictures_per_identity=3,
    )  # fmt: skip
    made = faces.generate(30, image_size=32, settings=settings)
    yaw, light = np.rad2deg(made.camera[:, 1]), made.light
    assert yaw.min() >= 21.99 and yaw.max() <= 38.01 and yaw.std() > 1
    assert np.rad2deg(light[:, 3]).min() >= 49.99 and np.rad2deg(light[:, 3]).max() <= 70.01
    assert 0.099 <= light[:, 0].min() <= light[:, 0].max() <= 0.201
    assert 0.899 <= light[:, 1].min() <= light[:, 1].max() <= 1.0
    assert set(made.expression.tolist()) == {"happy", "fear"}
    assert made.identity.tolist() == [i // 3 for i in range(30)]


def test_default_distribution_is_that_of_the_rendered_development_set():
    made = faces.generate(240, image_size=16)
    pitch, yaw, roll = np.rad2deg(made.camera[:, :3]).T
    assert abs(yaw.mean()) < 3 and 15 < yaw.std() < 21 and abs(yaw).max() <= 45.001
    assert 6.5 < pitch.std() < 9.5 and abs(pitch).max() <= 20.001
    assert 3 < roll.std() < 5 and abs(roll).max() <= 12.001
    assert abs(made.camera[:, 3:5]).max() <= 0.008001 and not made.camera[:, 5].any()
    assert set(made.expression.tolist()) == set(FaceSettings().expressions)
    assert (made.strength[made.expression == "neutral"] == 0).all()


def test_yaw_and_light_turn_the_way_the_conventions_say():
    ahead = {**STILL, **FRONTAL, "ambient": (0.3, 0.3), "diffuse": (0.4, 0.4), "pictures_per_identity": 1}
    left_lit = faces.generate(
        6, seed=9, settings=FaceSettings(**ahead, light_yaw_deg=(40, 40), light_pitch_deg=(0, 0))
    )
    columns = (left_lit.images.mean(axis=1) * left_lit.mask)[:, 20:50]
    assert (columns[..., 8:28].sum(axis=(1, 2)) > 1.1 * columns[..., 36:56].sum(axis=(1, 2))).all()
    turned = faces.generate(
        6, seed=9, settings=FaceSettings(**{**STILL, **FRONTAL}, yaw_mean_deg=25, pictures_per_identity=1)
    )
    nearest = np.where(turned.mask, turned.depth, 9.0)[:, 24:44].min(axis=1).argmin(axis=1)
    assert (nearest < 29).all()


@pytest.mark.parametrize("size", [32, 48, 128])
def test_other_sizes_show_the_same_face(size):
    reference, made = faces.generate(2, seed=3), faces.generate(2, seed=3, image_size=size)
    assert made.images.shape == (2, 3, size, size)
    centre = faces.generate(2, seed=3, image_size=size).depth[:, size // 2, size // 2]
    assert np.allclose(centre, reference.depth[:, 32, 32], atol=6e-3)
    assert np.allclose(made.images.mean(axis=(2, 3)), reference.images.mean(axis=(2, 3)), atol=6.0)


def test_progress_counts_up_to_the_end():
    seen: list[tuple[int, int]] = []
    faces.generate(20, image_size=16, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (20, 20) and [d for d, _ in seen] == sorted({d for d, _ in seen})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count must be 1 or more"),
        ({"count": 2, "image_size": 8}, "image_size must be 16..1024"),
        ({"count": 2, "seed": -1}, "seed and first must be 0 or more"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        faces.generate(**arguments)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"ambient": (0.7, 0.2)}, "low <= high"),
        ({"ambient": (0.2, 1.7)}, "ambient must lie within"),
        ({"light_yaw_deg": (0, 95)}, "light_yaw_deg must lie within"),
        ({"expressions": ("smug",)}, "expressions must be one or more of neutral"),
        ({"expressions": ()}, "expressions must be one or more"),
        ({"backgrounds": ("beach",)}, "backgrounds must be"),
        ({"pictures_per_identity": 0}, "pictures_per_identity"),
        ({"yaw": 3}, "yaw"),
    ],
)
def test_bad_settings_are_named(setting, message):
    with pytest.raises(ValueError, match=message):
        FaceSettings(**setting)
