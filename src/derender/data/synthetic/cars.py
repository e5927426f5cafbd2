"""Procedural cars: class, shape, paint, light and view are drawn, the car is rendered with exact truth.

Each image is a function of the seed and its index alone: asking for more images does not change the first
ones, nor does the number of threads. Conventions are those of docs/conventions.md and of the rendered
development set: a car's bounding box is centred on (0, 0, 1). The view is a turntable's: M = Rz(inplane)
Rx(elevation) Ry(azimuth) takes the upright car, front towards the viewer, to the camera. The canonical frame
is the car seen from straight ahead and 42.5 degrees above, so the camera's rotation is R = M Rx(42.5)^-1,
given by its Euler angles."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from derender.data.synthetic.car_model import build_car
from derender.data.synthetic.car_traits import CarTraits, draw_traits
from derender.data.synthetic.decals import PARTS, Paint
from derender.data.synthetic.mesh_image import TriangleMesh, draw_meshes, shift_room
from derender.data.synthetic.settings import CarSettings, clipped, either_side, name_at, scaled
from derender.data.synthetic.synthetic_set import FOV_DEG, Maps, Row, SyntheticSet, draw_background, make_set

CANONICAL_ELEVATION_DEG = 42.5
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Car:
    """A model: its mesh in the canonical frame, relative to the object's centre, at its size; its paint."""

    traits: CarTraits
    mesh: TriangleMesh
    paint: Paint


@dataclass(frozen=True)
class CarDraw:
    """One image's draw: angles in degrees, ``rotation`` canonical to camera, the ``shift`` requested."""

    model: int
    elevation_deg: float
    azimuth_deg: float
    inplane_deg: float
    rotation: Float64[ndarray, "3 3"]
    shift: Float64[ndarray, "2"]
    light: Float32[ndarray, "4"]
    background: Float32[ndarray, "s s 3"]


def generate(
    count: int,
    image_size: int = 64,
    seed: int = 0,
    settings: CarSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    first: int = 0,
) -> SyntheticSet:
    """``count`` images, from index ``first`` on; ``progress(done, count)`` is called as they are made.

    ``labels`` has ``class``, ``style`` (body style), ``model`` (CLASS/NUMBER) and the turntable's angles in
    degrees; ``parts`` counts into ``decals.PARTS``; ``identity`` is the model's number."""
    settings = settings or CarSettings()

    def work(indices: range, maps: Maps) -> list[tuple[Row, Row]]:
        draws = [draw_car(seed, index, image_size, settings) for index in indices]
        models = {number: model_car(seed, number, settings) for number in sorted({d.model for d in draws})}
        shown = [models[d.model] for d in draws]
        for n, (draw, car) in enumerate(zip(draws, shown, strict=True)):
            shift = _shift_inside(car.mesh.vertices, draw.rotation, draw.shift)
            maps["camera"][n] = *euler_angles(draw.rotation), *shift, 0.0
            maps["light"][n], maps["identity"][n] = draw.light, draw.model
        draw_meshes([(car.mesh, car.paint) for car in shown], 0.0, [d.background for d in draws], maps)
        return [(_labels(d, car.traits), _traits(car.traits)) for d, car in zip(draws, shown, strict=True)]

    return make_set(
        work, lambda: None, count, image_size, seed, first, settings.pictures_per_model, PARTS, progress
    )


def model_car(seed: int, number: int, settings: CarSettings | None = None) -> Car:
    """Model ``number`` of a seed, as ``generate`` renders it."""
    settings = settings or CarSettings()
    traits = draw_traits(class_of(seed, number, settings), np.random.default_rng([seed, 5, number]))
    mesh, paint = build_car(traits)
    upright = mesh.vertices.astype(np.float64)
    low, high = upright.min(axis=0), upright.max(axis=0)
    centred = (upright - 0.5 * (low + high)) * (settings.size / np.linalg.norm(high - low))
    turn = about_x(CANONICAL_ELEVATION_DEG).T
    vertices, normals = ((points @ turn).astype(np.float32) for points in (centred, mesh.normals))
    return Car(traits, mesh._replace(vertices=vertices, normals=normals), paint)


def class_of(seed: int, model: int, settings: CarSettings) -> str:
    """The class of a model. Shares are kept closely by any run of models: a golden-ratio sequence."""
    start = np.random.default_rng([seed, 4]).random()
    return name_at(settings.classes, (start + model * _GOLDEN) % 1.0)


def draw_car(seed: int, index: int, image_size: int, settings: CarSettings) -> CarDraw:
    """The draw of image number ``index``, a function of seed and index alone."""
    generator = np.random.default_rng([seed, 3, index])
    normal = generator.standard_normal(3)
    uniform = generator.random(8)
    view = settings.view
    elevation, azimuth = scaled(view.elevation_deg, uniform[0]), scaled(view.azimuth_deg, uniform[1])
    if view.azimuth_beyond_deg > 0:
        azimuth = either_side(view.azimuth_deg, view.azimuth_beyond_deg, uniform[1])
    inplane = clipped(view.inplane_sd_deg * normal[0], view.inplane_deg)
    kind = settings.backgrounds[int(uniform[7] * len(settings.backgrounds))]
    return CarDraw(
        model=settings.first_model + index // settings.pictures_per_model,
        elevation_deg=elevation,
        azimuth_deg=azimuth,
        inplane_deg=inplane,
        rotation=view_rotation(elevation, azimuth, inplane) @ about_x(CANONICAL_ELEVATION_DEG).T,
        shift=np.clip(view.shift_sd * normal[1:], *view.shift),
        light=settings.light.draw(uniform[2:7], settings.brightest),
        background=draw_background(kind, generator, image_size),
    )


def view_rotation(elevation_deg: float, azimuth_deg: float, inplane_deg: float) -> Float64[ndarray, "3 3"]:
    """M, from the upright car to the camera's axes."""
    a, b = np.deg2rad([azimuth_deg, inplane_deg])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    return about_z @ about_x(elevation_deg) @ about_y


def about_x(angle_deg: float) -> Float64[ndarray, "3 3"]:
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def euler_angles(rotation: Float64[ndarray, "3 3"]) -> Float64[ndarray, "3"]:
    """Angles about x, y, z (radians) of R = Rz Ry Rx."""
    x = np.arctan2(rotation[2, 1], rotation[2, 2])
    y = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    return np.array([x, y, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _shift_inside(
    vertices: Float32[ndarray, "v 3"], rotation: Float64[ndarray, "3 3"], shift: Float64[ndarray, "2"]
) -> Float64[ndarray, "2"]:
    """The shift, limited so that the turned vertices stay in the image; one without room is centred."""
    room = np.empty((2, 2))
    shift_room(vertices, rotation, np.tan(np.deg2rad(FOV_DEG / 2)), room)
    low, high = room
    return np.where(low < high, np.clip(shift, low, high), 0.5 * (low + high))


def _labels(draw: CarDraw, car: CarTraits) -> Row:
    row: Row = {"class": car.name, "style": car.style, "model": f"{car.name}/{draw.model:05d}"}
    angles = {"elev": draw.elevation_deg, "azim": draw.azimuth_deg, "inplane": draw.inplane_deg}
    return row | {name: np.float32(angle) for name, angle in angles.items()}


def _traits(car: CarTraits) -> Row:
    row: Row = {name: getattr(car.shape, name) for name in ("length", "width", "height", "wheel", "soft")}
    for name, colour in (("paint", car.paint), ("roof", car.roof), ("glass", car.glass)):
        row |= {f"{name}_{k}": v for k, v in zip(("red", "green", "blue"), colour, strict=True)}
    return row
