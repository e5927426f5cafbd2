"""Procedural cars: class, shape, paint, light and view are drawn, the car is pictured with exact truth.

Each picture is a function of the seed and its index alone: asking for more pictures does not change the
first ones, nor does the number of threads. Conventions are those of docs/conventions.md and of the rendered
development set: a car's bounding box is centred on (0, 0, 1), the canonical view is from straight ahead and
42.5 degrees above."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from derender.data.synthetic.batches import FOV_DEG, Maps, Row, check_request, make_set
from derender.data.synthetic.car_decals import PARTS
from derender.data.synthetic.car_draw import (
    CANONICAL_ELEVATION_DEG,
    CarDraw,
    about_x,
    class_of,
    draw_car_picture,
    euler_angles,
)
from derender.data.synthetic.car_model import CarModel, build_car
from derender.data.synthetic.car_picture import draw_car, shift_room
from derender.data.synthetic.car_settings import CarSettings
from derender.data.synthetic.car_traits import CarTraits, draw_traits
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.scene.camera import focal_px


def generate(
    count: int,
    image_size: int = 64,
    seed: int = 0,
    settings: CarSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    first: int = 0,
) -> SyntheticSet:
    """``count`` pictures, from index ``first`` on; ``progress(done, count)`` is called as they are made.

    ``labels`` has ``class``, ``style`` (body style), ``model`` (CLASS/NUMBER) and the turntable's angles in
    degrees; ``parts`` counts into ``car_decals.PARTS``; ``identity`` is the model's number."""
    settings = settings or CarSettings()
    check_request(count, image_size, seed, first)

    def work(indices: range, maps: Maps) -> list[tuple[Row, Row]]:
        draws = [draw_car_picture(seed, index, image_size, settings) for index in indices]
        cars = {number: model_car(seed, number, settings) for number in sorted({d.model for d in draws})}
        _pictures(draws, [cars[d.model] for d in draws], image_size, maps)
        return [(_labels(d, cars[d.model].traits), _traits(cars[d.model].traits)) for d in draws]

    return make_set(work, count, image_size, first, settings.pictures_per_model, PARTS, progress)


@dataclass(frozen=True)
class ModelCar:
    """A car in the canonical frame, relative to the object's centre, at its size."""

    traits: CarTraits
    model: CarModel
    vertices: Float32[ndarray, "v 3"]
    normals: Float32[ndarray, "v 3"]


def model_car(seed: int, number: int, settings: CarSettings | None = None) -> ModelCar:
    """Model ``number`` of a seed: what ``generate`` pictures."""
    settings = settings or CarSettings()
    traits = draw_traits(class_of(seed, number, settings), np.random.default_rng([seed, 5, number]))
    model = build_car(traits)
    upright = model.mesh.vertices.astype(np.float64)
    low, high = upright.min(axis=0), upright.max(axis=0)
    centred = (upright - 0.5 * (low + high)) * (settings.size / np.linalg.norm(high - low))
    turn = about_x(CANONICAL_ELEVATION_DEG).T
    return ModelCar(
        traits, model, (centred @ turn).astype(np.float32), (model.mesh.normals @ turn).astype(np.float32)
    )


def _pictures(draws: list[CarDraw], cars: list[ModelCar], size: int, out: Maps) -> None:
    """Draw the pictures of one batch into ``out``."""
    for n, (draw, car) in enumerate(zip(draws, cars, strict=True)):
        shift = shift_inside(car.vertices, draw.rotation, draw.shift)
        out["camera"][n] = *euler_angles(draw.rotation), *shift, 0.0
        out["light"][n], out["identity"][n] = draw.light, draw.model
    rotation, direction = camera_rotation_and_light(out["camera"], out["light"])
    light = np.hstack([out["light"][:, :2], direction]).astype(np.float32)
    rotation, focal = rotation.astype(np.float32), np.float32(focal_px(size, FOV_DEG))
    for n, car in enumerate(cars):
        mesh, paint = car.model.mesh, car.model.paint
        draw_car(
            car.vertices, car.normals, mesh.chart, mesh.triangles, mesh.surface,
            paint.colour, paint.part, paint.first, paint.folded, paint.decals, paint.first_hole, paint.holes,
            rotation[n], out["camera"][n, 3:], light[n], draws[n].background, size, focal,
            out["images"][n], out["depth"][n], out["normal"][n], out["albedo"][n], out["mask"][n],
            out["parts"][n],
        )  # fmt: skip


def shift_inside(
    vertices: Float32[ndarray, "v 3"], rotation: Float64[ndarray, "3 3"], shift: Float64[ndarray, "2"]
) -> Float64[ndarray, "2"]:
    """The shift, limited so that the turned vertices stay in the picture; what does not fit is centred."""
    room = np.empty((2, 2))
    shift_room(vertices, rotation, np.tan(np.deg2rad(FOV_DEG / 2)), room)
    low, high = room
    return np.where(low < high, np.clip(shift, low, high), 0.5 * (low + high))


def _labels(draw: CarDraw, car: CarTraits) -> Row:
    return {
        "class": car.name,
        "style": car.style,
        "model": f"{car.name}/{draw.model:05d}",
        "elev": np.float32(draw.elevation_deg),
        "azim": np.float32(draw.azimuth_deg),
        "inplane": np.float32(draw.inplane_deg),
    }


def _traits(car: CarTraits) -> Row:
    names = ("length", "width", "height", "wheel", "soft")
    colours = {"paint": car.paint, "roof": car.roof, "glass": car.glass}
    return {name: getattr(car.shape, name) for name in names} | {
        f"{name}_{channel}": value
        for name, colour in colours.items()
        for channel, value in zip(("red", "green", "blue"), colour, strict=True)
    }
