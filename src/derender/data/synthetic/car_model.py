"""A car's traits to one painted mesh: body, fittings, paint."""

from dataclasses import dataclass

import numpy as np

from derender.data.synthetic.car_body import ARCH, body_grid
from derender.data.synthetic.car_decals import PaintTable, Surface, paint_table
from derender.data.synthetic.car_fittings import fittings
from derender.data.synthetic.car_livery import side_livery, top_livery
from derender.data.synthetic.car_mesh import CarMesh, Grid, join, part_of, smooth_grid
from derender.data.synthetic.car_paint import side_decals, top_decals
from derender.data.synthetic.car_traits import CarTraits


@dataclass(frozen=True)
class CarModel:
    """Mesh in metres (x right, y down, z to the rear; ground at y = 0) and its paint."""

    mesh: CarMesh
    paint: PaintTable


def build_car(car: CarTraits) -> CarModel:
    surfaces: list[Surface] = []

    def place(surface: Surface) -> int:
        surfaces.append(surface)
        return len(surfaces) - 1

    body = body_grid(car.shape)
    top = place(Surface(car.paint, "body", (*top_livery(car), *top_decals(car)), folded=True))
    s = car.shape
    holes = tuple((at, s.wheel, ARCH * s.wheel) for at in (s.front_wheel, s.rear_wheel) if car.name != "jeep")
    side = place(Surface(car.paint, "body", (*side_livery(car), *side_decals(car)), holes=holes))
    whole = smooth_grid(body.points, body.chart_top, top)
    first, last, columns = body.top.start, body.top.stop, body.points.shape[1]
    pieces: list[Grid] = [
        part_of(whole, slice(0, first + 1), body.chart_side, side),
        part_of(whole, body.top, body.chart_top, top),
        part_of(whole, slice(last - 1, columns), body.chart_side, side),
    ]
    flank = body.points[:, last:].reshape(-1, 3)

    def half_width(z: float, y: float) -> float:
        """The body's half width about that place."""
        return float(flank[np.argmin((flank[:, 2] - z) ** 2 + (flank[:, 1] - y) ** 2), 0])

    pieces += fittings(car, half_width, place)
    return CarModel(join(pieces), paint_table(surfaces))
