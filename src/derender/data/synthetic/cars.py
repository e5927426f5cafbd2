"""Procedural cars: class, shape, paint, light and view are drawn, the car is rendered with exact truth.

Twelve classes: seven body styles and five that differ by more than their body. Measures are metres: a row of
``cars.yaml`` for each body style (typical outside measures of road cars, rounded) times small independent
factors. Everything mounted on the body is a rounded box or a wheel, placed by the body's measures, in mirror
images or across the middle. Leaves out rust, dirt and damage; no existing car is drawn.

Each image is a function of the seed and its index alone. The view is a turntable's: M = Rz(inplane)
Rx(elevation) Ry(azimuth) takes the upright car, front towards the viewer, to the camera. The canonical frame
is the car seen from straight ahead and 42.5 degrees above: the camera's rotation is R = M Rx(42.5)^-1.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from derender.data.stream import Progress
from derender.data.synthetic.car_body import PARTS, CarShape
from derender.data.synthetic.car_parts import CarTraits, build_car
from derender.data.synthetic.mesh_image import TriangleMesh
from derender.data.synthetic.settings import CLASSES, CarSettings, drawn, numbers_of, pick
from derender.data.synthetic.synthetic_set import FOV_DEG, Row, Shot, SyntheticSet, draw_background, make_set

CANONICAL_ELEVATION_DEG = 42.5
_GOLDEN = 0.6180339887498949
_PAINT_WHITE, _PAINT_BLACK = (0.92, 0.92, 0.91), (0.075, 0.075, 0.08)
_ALONG = ["length", "front_wheel", "rear_wheel", *(one for one in CarShape._fields if one.endswith("_at"))]
_UP = ("height", "nose", "cowl", "deck", "tail", "bumper")
_PLASTIC = {"suv": 0.6, "van": 0.6, "pickup": 0.6, "jeep": 1.0, "hatchback": 0.15}  # chance of such bumpers


def generate(
    count: int, image_size: int = 64, seed: int = 0, settings: CarSettings | None = None,
    progress: Progress | None = None, first: int = 0,
) -> SyntheticSet:  # fmt: skip
    """``count`` images, from index ``first`` on; ``progress(done, count)`` is called as they are made.

    ``labels`` has ``class``, ``style`` (body style), ``model`` (CLASS/NUMBER) and the turntable's angles in
    degrees; ``parts`` counts into ``car_body.PARTS``; ``identity`` is the model's number."""
    settings = settings or CarSettings()

    def shots(indices: list[int]) -> Iterator[Shot]:
        number = settings.first_model + indices[0] // settings.pictures_per_model
        car = model_car(seed, number, settings)
        return (draw_car(seed, index, image_size, settings, car, number) for index in indices)

    size = settings.pictures_per_model
    return make_set(shots, count, image_size, seed, first, size, PARTS, progress, settings.effects)


@dataclass(frozen=True)
class Car:
    """A model: traits, a row of them for tables, its mesh about its centre in the canonical frame."""

    traits: CarTraits
    row: Row
    mesh: TriangleMesh


def model_car(seed: int, number: int, settings: CarSettings) -> Car:
    """Model ``number`` of a seed, as ``generate`` renders it."""
    traits = draw_traits(class_of(seed, number, settings), np.random.default_rng([seed, 5, number]))
    mesh = build_car(traits)
    upright = mesh.vertices.astype(np.float64)
    low, high = upright.min(axis=0), upright.max(axis=0)
    centred = (upright - 0.5 * (low + high)) * (settings.size / np.linalg.norm(high - low))
    turn = about_x(CANONICAL_ELEVATION_DEG).T
    vertices, normals = ((points @ turn).astype(np.float32) for points in (centred, mesh.normals))
    row: Row = {name: getattr(traits.shape, name) for name in ("length", "width", "height", "wheel", "soft")}
    for name in ("paint", "roof", "glass"):
        names = (f"{name}_{channel}" for channel in ("red", "green", "blue"))
        row |= dict(zip(names, getattr(traits, name), strict=True))
    return Car(traits, row, mesh._replace(vertices=vertices, normals=normals))


def class_of(seed: int, model: int, settings: CarSettings) -> str:
    """The class of a model. Shares are kept closely by any run of models: a golden-ratio sequence."""
    at = (np.random.default_rng([seed, 4]).random() + model * _GOLDEN) % 1.0
    return list(settings.classes)[pick([*settings.classes.values()], at)]


def draw_car(seed: int, index: int, image_size: int, settings: CarSettings, car: Car, number: int) -> Shot:
    """Image ``index`` of model ``number``: light, view and background."""
    generator, view = np.random.default_rng([seed, 3, index]), settings.view
    normal, uniform = generator.standard_normal(3), generator.random(8)
    elevation = drawn(view.elevation_deg, uniform[0])
    azimuth = drawn(view.azimuth_deg, uniform[1], view.azimuth_beyond_deg)
    inplane = min(max(view.inplane_sd_deg * normal[0], view.inplane_deg[0]), view.inplane_deg[1])
    kind = settings.backgrounds[int(uniform[7] * len(settings.backgrounds))]
    turn = Rotation.from_euler("ZXY", [inplane, elevation, azimuth], degrees=True).as_matrix()
    rotation = turn @ about_x(CANONICAL_ELEVATION_DEG).T
    place = rotation @ car.mesh.vertices.T
    reach = np.tan(np.deg2rad(FOV_DEG / 2)) * (place[2] + 1.0)  # within which all vertices must stay
    low, high = (-reach - place[:2]).max(axis=1), (reach - place[:2]).min(axis=1)
    shift = np.clip(view.shift_sd * normal[1:], *view.shift)
    shift = np.where(low < high, np.clip(shift, low, high), 0.5 * (low + high))
    name = car.traits.name
    labels: Row = {"class": name, "style": car.traits.style, "model": f"{name}/{number:05d}"}
    labels |= {"elev": np.float32(elevation), "azim": np.float32(azimuth), "inplane": np.float32(inplane)}
    background = draw_background(kind, generator, image_size)
    light = settings.light.draw(uniform[2:7], settings.brightest)
    angles = Rotation.from_matrix(rotation).as_euler("xyz")  # R = Rz Ry Rx
    camera = np.array([*angles, *shift, 0.0], np.float32)
    return Shot(car.mesh, background, light, camera, number, labels, car.row)


def about_x(angle_deg: float) -> Float64[ndarray, "3 3"]:
    return Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()


def draw_traits(name: str, generator: np.random.Generator) -> CarTraits:
    """A model of class ``name``. Draws the same number of random values whatever the class."""
    uniform, spread = generator.random(24).tolist(), generator.standard_normal(8)
    style = CLASSES[name][int(uniform[0] * len(CLASSES[name]))]
    shape = _draw_shape(style, generator, 1.5 + 1.0 * uniform[1] if name == "limousine" else 0.0)
    livery, palettes = int(uniform[2] * 3), numbers_of("cars")["palettes"]
    palette = np.array(palettes.get(name, palettes["usual"]))
    tint = np.clip(spread[:3], -2, 2)  # a little lighter or darker, and each channel on its own
    colour = palette[pick(palette[:, 3], uniform[3]), :3] * (1.0 + 0.10 * tint[0]) * (1.0 + 0.05 * tint)
    paint: Any = tuple(np.clip(colour, 0.03, 0.95).tolist())
    if name == "police":
        paint = (_PAINT_BLACK, _PAINT_WHITE, _PAINT_WHITE)[livery]
    roof = paint
    if uniform[4] < {"suv": 0.3, "hatchback": 0.2}.get(name, 0.0):
        roof = _PAINT_WHITE if sum(paint) < 1.4 else _PAINT_BLACK
    if uniform[4] < {"sports": 0.25, "coupe": 0.25, "jeep": 0.6}.get(name, 0.0):
        roof = _PAINT_BLACK if name != "jeep" or uniform[5] < 0.6 else _PAINT_WHITE
    grey = 0.06 + 0.10 * uniform[6] + (0.08 if sum(paint) < 0.5 else 0.0)
    bright = 0.25 if uniform[8] < 0.2 else 0.55 + 0.25 * uniform[9]
    trim = 0.07 + 0.06 * uniform[10]
    plastic = (trim, trim, trim * 1.05)
    glass = (grey, grey * (1.05 + 0.2 * uniform[7]), grey * (1.15 + 0.5 * uniform[7]))
    rim, spokes = (bright, bright, bright * 1.02), 5 + int(uniform[12] * 4)
    bumpers = plastic if uniform[11] < _PLASTIC.get(name, 0.0) else paint
    fittings = (rim, plastic, bumpers, spokes, uniform[13:23], livery)
    return CarTraits(name, style, shape, paint, roof, glass, *fittings)


def _draw_shape(style: str, generator: np.random.Generator, stretch: float) -> CarShape:
    """A model of that style; ``stretch`` metres are put in behind the front doors (limousines)."""
    row = CarShape(*numbers_of("cars")["measures"][style])
    normal = np.clip(generator.standard_normal(len(row)), -2.0, 2.0).tolist()
    factor = {name: 1.0 + 0.03 * z for name, z in zip(CarShape._fields, normal, strict=True)}
    common = dict.fromkeys(_ALONG, factor["length"]) | dict.fromkeys(_UP, factor["height"])  # as ordered
    drawn_row = {name: value * (factor | common)[name] for name, value in row._asdict().items()}
    between = factor["cowl"] - 1.0  # a longer or shorter bonnet moves the windscreen as a whole
    drawn_row["cowl_at"] += 1.2 * between
    drawn_row["screen_at"] += 1.2 * between + 2.0 * row.soft * (factor["screen_at"] - 1.0)
    if row.roof_end_at < row.deck_at - 0.25 and row.bed == 0.0:
        drawn_row["roof_end_at"] += 4.0 * row.soft * (factor["roof_end_at"] - 1.0)
    drawn_row["soft"] = min(1.0, row.soft * (1.0 + 5.0 * (factor["soft"] - 1.0)))
    drawn_row["bow"] = row.bow * (1.0 + 5.0 * (factor["bow"] - 1.0))
    drawn_row["nose"] *= factor["nose"]
    for name in ("length", "rear_wheel", "roof_end_at", "deck_at", "tail_at"):
        drawn_row[name] += stretch
    return CarShape(**drawn_row)
