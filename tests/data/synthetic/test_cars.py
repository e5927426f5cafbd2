"""Procedural cars: reproducible to the byte, exactly symmetric, and every truth map explains its image."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from derender.data.synthetic import CarSettings, CarViewSettings, cars
from derender.data.synthetic.cars import about_x, class_of, draw_traits
from derender.data.synthetic.settings import CLASSES, numbers_of
from derender.data.synthetic.synthetic_set import SyntheticSet
from derender.scene.camera import project, rotation_matrix, to_camera

FOUR_EACH = CarSettings(pictures_per_model=4)


@pytest.fixture(scope="module")
def sample() -> SyntheticSet:
    return cars.generate(32, seed=3, settings=FOUR_EACH)


def test_every_class_occurs_soon_and_shares_are_kept(sample):
    for seed in range(5):
        assert {class_of(seed, model, CarSettings()) for model in range(24)} == set(CLASSES)
    uneven = CarSettings(classes={"jeep": 3.0, "van": 1.0, "police": 0.0})
    names = [class_of(0, model, uneven) for model in range(200)]
    assert names.count("police") == 0 and abs(names.count("jeep") - 150) <= 3
    styles = zip(sample.labels["class"], sample.labels["style"], strict=True)
    assert all(style in CLASSES[name] for name, style in styles)


def test_every_condition_of_the_tables_can_hold():
    """A misspelt one never would."""
    tables, numbers = numbers_of("cars"), np.random.default_rng(0)
    facts = {fact for name in 20 * list(CLASSES) for fact in draw_traits(name, numbers).facts}
    rows = [row[4:] for chart in tables["shapes"].values() for row in chart]
    rows += [row[5] for row in tables["fittings"]] + [row[2:] for row in tables["choices"].values()]
    assert {one.removeprefix("not ") for conditions in rows for one in conditions} <= facts


@pytest.mark.parametrize("number", range(12))
def test_meshes_are_mirror_symmetric_and_at_their_size(number):
    car = cars.model_car(1, number, CarSettings(classes=list(CLASSES)))
    points = np.hstack([car.mesh.vertices, car.mesh.normals]).astype(np.float64)
    flip = np.array([-1.0, 1.0, 1.0])
    apart, _ = cKDTree(points[:, :3]).query(points[:, :3] * flip)
    assert apart.max() < 1e-7
    upright = points[:, :3] @ about_x(42.5)
    low, high = upright.min(axis=0), upright.max(axis=0)
    assert np.allclose(low + high, 0.0, atol=1e-6) and abs(np.linalg.norm(high - low) - 0.198) < 1e-6
    assert np.allclose(np.linalg.norm(points[:, 3:], axis=1)[used(car)], 1.0, atol=1e-5)


def used(car: cars.Car) -> np.ndarray:
    """Vertices of triangles that have an area."""
    corners = car.mesh.vertices[car.mesh.triangles].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.unique(car.mesh.triangles[area > 1e-9])


def test_depth_and_parts_lie_in_the_stated_ranges(sample):
    assert sample.depth[sample.mask].min() > 0.9 and sample.depth[sample.mask].max() < 1.1
    assert 0.2 < sample.mask.mean() < 0.4
    assert set(np.unique(sample.parts).tolist()) == set(range(len(sample.part_names)))
    for name in ("body", "window", "light", "trim"):
        shown = (sample.parts == sample.part_names.index(name)).any(axis=(1, 2))
        assert shown.mean() > 0.9, name


def test_cameras_are_the_turntable_that_the_labels_say(sample):
    turned = rotation_matrix(torch.from_numpy(sample.camera[:, :3].astype(np.float64))).numpy()
    angles = np.stack([sample.labels[name] for name in ("inplane", "elev", "azim")], axis=1)
    wanted = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix() @ about_x(42.5).T
    assert np.abs(turned - wanted).max() < 1e-6
    assert sample.labels["elev"].min() >= 25 and sample.labels["elev"].max() <= 60
    assert np.abs(sample.labels["azim"]).max() <= 30 and np.abs(sample.labels["inplane"]).max() <= 8


def test_shifts_keep_cars_inside_the_picture():
    """Shifts far beyond the frame are cut: every vertex still projects between the outermost pixels."""
    view = CarViewSettings(shift_sd=0.1, shift=(-0.1, 0.1))
    settings = CarSettings(view=view, classes=("sedan",), pictures_per_model=8)
    made = cars.generate(8, settings=settings)
    vertices = torch.from_numpy(cars.model_car(0, 0, settings).mesh.vertices.astype(np.float64))
    vertices[:, 2] += 1.0
    seen = to_camera(vertices.expand(8, -1, 3), torch.from_numpy(made.camera.astype(np.float64)))
    place = project(seen, 64, 64, made.fov_deg)
    assert place.min() > -1e-3 and place.max() < 63 + 1e-3
    assert ((place.amin(dim=(1, 2)) < 0.01) | (place.amax(dim=(1, 2)) > 62.99)).sum() >= 7  # and no further
