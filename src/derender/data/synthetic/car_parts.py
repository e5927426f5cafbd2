"""A car put together: body and wheels, the shapes of paint and the boxes on them that ``cars.yaml`` lists.

There are two charts. (share of the half width, station) is on top, where one row of shapes suits every body
style. (z, y) in metres is beside, where windows follow the body's lines. Police cars, ambulances and sports
cars carry usual colours and patterns: black and white, a blue band, blue and yellow fields, orange stripes
and a cross or a six-pointed star. None is that of an existing service. Leaves out interiors behind the glass
and lettering that can be read.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from derender.data.synthetic import car_body as body
from derender.data.synthetic.car_body import CarShape, Colour, Decal, Grid, Places, Surface, both, metres
from derender.data.synthetic.decals import BOX, DECAL_LENGTH, ELLIPSE, MOST_CORNERS
from derender.data.synthetic.mesh_image import TriangleMesh
from derender.data.synthetic.settings import drawn, numbers_of

Finish = tuple[float, ...]  # columns of a shape: if its colour multiplies that below, part or -1, colour
Lengths = Sequence[str | float]


@dataclass(frozen=True)
class CarTraits:
    """One model."""

    name: str  # its class
    style: str  # its body style
    shape: CarShape
    paint: Colour  # of the body
    roof: Colour
    glass: Colour  # of the windows
    rim: Colour  # of the wheels
    trim: Colour  # of plastic
    bumpers: Colour  # the body's or the trim's
    spokes: int  # of a wheel
    chances: list[float]  # ten uniform numbers that decide on fittings, each by its own position
    livery: int  # which of its class's liveries (police, ambulance, sports)

    @cached_property
    def facts(self) -> frozenset[str]:
        """All that holds of this car of what conditions in ``cars.yaml`` name."""
        tables, brightness = numbers_of("cars"), sum(self.paint)
        holds = {name: self.chances[at] < below for name, (at, below) in tables["chances"].items()}
        holds |= {kind: self.name in names for kind, names in tables["class_kinds"].items()}
        holds |= {kind: self.style in names for kind, names in tables["body_kinds"].items()}
        holds |= {"plastic": self.bumpers != self.paint, "other roof": self.roof != self.paint}
        holds |= {"bed": self.shape.bed > 0, "dark": brightness < 1.0, "pale": brightness >= 1.9}
        return frozenset({self.name, f"livery {self.livery}", *(name for name in holds if holds[name])})

    @cached_property
    def places(self) -> Places:
        """Its measures, and the lengths that chance, the body's lines and ``cars.yaml`` derive, by name."""
        tables, s = numbers_of("cars"), self.shape
        places = {**s._asdict(), "spokes": float(self.spokes)}
        edge = body.body_lines(s, np.array([4.1, 4.5, 4.9])).edge  # where rails lie
        bed = body.body_lines(s, np.array([body.BED_FROM, body.BED_TO]))
        for name, (at, *ends) in tables["drawn"].items():
            places[name] = drawn((ends[0], ends[1]), self.chances[at])
        places["bed_from"], places["bed_to"] = bed.middle[:, 2].tolist()
        places["lamp_u"], places["lamp_v"] = 0.105 / (0.41 * s.width), 0.105 / (s.nose - s.bumper)
        places["rail_x"], places["rail_half"] = 0.93 * edge[:, 0].min(), 0.5 * (edge[-1, 2] - edge[0, 2])
        places["rail_y"], places["rail_z"] = edge[:, 1].mean() + 0.05, edge[:, 2].mean()
        for name, length in tables["places"].items():
            places[name] = metres(length, places)
        return places

    def has(self, conditions: Sequence[str]) -> bool:
        """Whether all conditions hold: facts, or "not" and a fact."""
        return all((one.removeprefix("not ") in self.facts) != one.startswith("not ") for one in conditions)

    def finish(self, colour: str | float, part: str = "") -> Finish:
        """A colour and a part, by their names or by what ``cars.yaml`` has the car choose by."""
        number = body.PARTS.index(self.chosen(part)) if part else -1
        if not isinstance(colour, str):
            return (True, number, colour, colour, colour)
        return (False, number, *self.colour(colour))

    def colour(self, name: str) -> Colour:
        """A colour of the car's own or of ``cars.yaml``, by its name."""
        name, fixed = self.chosen(name), numbers_of("cars")["colours"]
        return tuple(fixed[name]) if name in fixed else getattr(self, name)

    def chosen(self, name: str) -> str:
        """The name of a colour or part that ``cars.yaml`` has the car choose under this one; else itself."""
        while name in (choices := numbers_of("cars")["choices"]):
            one, other, *conditions = choices[name]
            name = one if self.has(conditions) else other
        return name


def build_car(car: CarTraits) -> TriangleMesh:
    """Mesh in metres (x right, y down, z to the rear; ground at y = 0) with its paint."""
    s, jeep, black = car.shape, car.name == "jeep", Surface(car.colour("black"))
    wheels = (s.front_wheel, s.rear_wheel)
    holes = [(at, s.wheel, 0.0 if jeep else body.ARCH * s.wheel) for at in wheels]
    side = Surface(car.paint, "body", side_paint(car), holes=holes)
    pieces, flank = body.body_pieces(s, Surface(car.paint, "body", shapes("top", car)), side)
    tyre = Surface(car.colour("tyre"), "wheel", shapes("wheel", car))
    wheel = body.wheel((0, s.wheel, 0), s.wheel, 0.28 if jeep else 0.24, tyre)
    for at in wheels:
        out, houses = s.width / 2 + 0.15, []
        if not jeep:
            z, y = np.meshgrid([-1.1, 0.0, 1.1], [0.8, 1.2])
            out = body.half_width(flank, at + z * s.wheel, y * s.wheel).min() - 0.025
            houses = [body.wheel_house(out - 0.25, at, s, flank, black)]
        pieces += both([wheel._replace(points=wheel.points + np.array((out, 0.0, at))), *houses])
    beside = s.cowl_at + (0.1 if car.has(["upright"]) else 0.28)
    places = {**car.places, "mirror": body.half_width(flank, beside, s.cowl - 0.05) + 0.09}
    for row in numbers_of("cars")["fittings"]:
        pieces += fitting(car, places, *row)
    return body.join([*pieces, *([_spare_wheel(car)] if jeep else [])])


def _spare_wheel(car: CarTraits) -> Grid:
    """Upright at the rear, or on its back on the bonnet."""
    s = car.shape
    spare = Surface(car.colour("tyre"), "wheel", shapes("wheel", car) + shapes("spare", car))
    if car.has(["open"]) or not car.has(["spare on bonnet"]):
        return body.wheel((0, s.cowl - 0.08, s.length + 0.24), s.wheel * 0.95, 0.24, spare, backwards=True)
    lying = body.wheel((0, 0, 0), s.wheel * 0.92, 0.22, spare, backwards=True)
    middle = (0, 0.5 * (s.nose + s.cowl) + 0.16, 0.55 * (s.nose_at + s.cowl_at))
    points = (lying.points - lying.points[0, 0])[..., [0, 2, 1]] * (1.0, 1.0, -1.0) + middle
    return lying._replace(points=points, normals=lying.normals[..., [0, 2, 1]] * (1.0, -1.0, 1.0))


def shapes(chart: str, car: CarTraits, **more: float) -> list[Decal]:
    """The shapes of ``cars.yaml`` on a chart, none of ""; ``more`` are places beside the car's own."""
    places, rows = {**car.places, **more}, numbers_of("cars")["shapes"][chart] if chart else ()
    decals = []
    for kind, colour, part, numbers, *conditions in rows:
        if car.has(conditions):
            flat = (one for some in numbers for one in (some if isinstance(some, list) else [some]))
            decals += SHAPES[kind](car.finish(colour, part), *(metres(one, places) for one in flat))
    return decals


def fitting(
    car: CarTraits, places: Places, centre: Lengths, half: Lengths, radius: float, colour: str, part: str,
    conditions: Sequence[str], lean_rad: float = 0.0, charts: Sequence[str] = ("",) * 4,
) -> list[Grid]:  # fmt: skip
    """The rounded box of a row of ``cars.yaml``, on both sides where it is not in the middle; nothing where
    the row does not hold."""
    if not car.has(conditions):
        return []
    surfaces = [Surface(car.colour(colour), car.chosen(part), shapes(chart, car)) for chart in charts]
    at, sides = ([metres(one, places) for one in row] for row in (centre, half))
    pieces = body.rounded_box(at, sides, radius, surfaces, lean_rad)
    return both(pieces) if at[0] else pieces


def _decal(kind: int, finish: Finish, bounds: Sequence[float], *own: float) -> Decal:
    numbers = (kind, *finish, *bounds, *own)
    return numbers + (0.0,) * (DECAL_LENGTH - len(numbers))


def polygon(finish: Finish, *corners: Any) -> list[Decal]:
    """Of three to nine corners, each along both coordinates of the chart, in any direction."""
    numbers = np.ravel(corners).tolist()
    u, v = numbers[::2], numbers[1::2]
    assert 3 <= len(u) <= MOST_CORNERS, len(u)
    return [_decal(len(u), finish, (min(u), min(v), max(u), max(v)), *numbers)]


def inside(finish: Finish, u: float, v: float, *corners: float) -> list[Decal]:
    """A polygon that is smaller than one with these corners, about (u, v): the glass of a lamp."""
    middle = np.array([u, v])
    return polygon(finish, middle + (0.86, 0.76) * (np.reshape(corners, (-1, 2)) - middle))


def box(finish: Finish, u0: float, v0: float, u1: float, v1: float) -> list[Decal]:
    """Between two corners."""
    return [_decal(BOX, finish, (min(u0, u1), min(v0, v1), max(u0, u1), max(v0, v1)))]


def line(
    finish: Finish, u0: float, v0: float, u1: float, v1: float, across: float, along: float
) -> list[Decal]:
    """A thin line between two points, so wide along each coordinate."""
    u, v = 0.5 * across, 0.5 * along
    return polygon(finish, u0 - u, v0 - v, u1 - u, v1 - v, u1 + u, v1 + v, u0 + u, v0 + v)


def ellipse(
    finish: Finish, u: float, v: float, across: float, along: float, hollow: float = 0.0, gaps: float = 0.0,
    gap: float = 1.0,
) -> list[Decal]:  # fmt: skip
    """By its centre and radii; a ring where it is ``hollow`` up to that share of the radius.

    Of a ring that has ``gaps`` each is a ``gap`` of the circle's share: like those between spokes.
    """
    return [_decal(ELLIPSE, finish, (u - across, v - along, u + across, v + along), hollow, gaps, gap)]


def checker(
    finish: Finish, u0: float, v0: float, u1: float, v1: float, across: float, along: float, odd: float = 0
) -> list[Decal]:
    """Every second field, so wide and high, of a chequered rectangle."""
    decals = []
    for i, u in enumerate(np.arange(u0, u1, across).tolist()):
        for j, v in enumerate(np.arange(v0, v1, along).tolist()):
            if (i + j) % 2 == odd:
                decals += box(finish, u, v, min(u + across, u1), min(v + along, v1))
    return decals


def word(finish: Finish, v: float, half: float, tall: float) -> list[Decal]:
    """Bars in the middle that look like a word from afar."""
    u = half / 3.0 * (np.arange(3)[:, None] + (0.14, 0.86))
    return [decal for u0, u1 in u.tolist() for decal in box(finish, u0, v - tall / 2, u1, v + tall / 2)]


def star(finish: Finish, u: float, v: float, across: float, along: float) -> list[Decal]:
    """Six arms, as far from (u, v) along each coordinate."""
    decals = []
    for turn in np.pi * np.array([0.0, 1.0, 2.0]) / 3.0:
        up = np.array([across * np.sin(turn), along * np.cos(turn)])
        side = 0.17 * np.array([across * np.cos(turn), -along * np.sin(turn)])
        arm = np.array([up + side, up - side, -up - side, side - up])
        decals += polygon(finish, arm + np.array([u, v]))
    return decals


SHAPES: Mapping[str, Callable[..., list[Decal]]] = {
    one.__name__: one for one in (polygon, inside, box, line, ellipse, checker, word, star)
}


def side_paint(car: CarTraits) -> list[Decal]:
    """Shapes on both sides."""
    lines, doors = body.body_lines(car.shape, np.linspace(0.0, 9.0, 181)), _door_edges(car)
    edges = dict(zip(("doors_from", "post", "rear_post"), doors[:-1], strict=False), doors_to=doors[-1])
    nearest = {name: np.argmin(np.abs(lines.waist[:, 2] - at)) for name, at in edges.items()}
    places = edges | {f"{name}_waist": float(lines.waist[row, 1]) for name, row in nearest.items()}
    rows = (40, 48) if car.name == "sports" else (35, 41) if car.has(["narrow lamps"]) else (31, 40)
    for name, row in zip(("lamp", "lamp_end", "rear", "rear_end"), (*rows, 150, 140), strict=True):
        places[f"{name}_y"], places[f"{name}_z"] = lines.edge[row, 1:].tolist()
    return shapes("side", car, **places) + ([] if car.has(["open"]) else _windows(car, lines, doors))


def _door_edges(car: CarTraits) -> list[float]:
    """Where doors begin and end along the car."""
    s = car.shape
    first = max(s.front_wheel + 1.2 * s.wheel, s.cowl_at + 0.05)
    share = 0.9 if car.style != "pickup" else 1.0
    last = s.cowl_at + share * (min(s.deck_at, s.rear_wheel + 0.35) - s.cowl_at)
    if car.has(["two doors"]):
        return [first, min(first + numbers_of("cars")["doors"].get(car.style, 1.3), last)]
    if car.name == "limousine":
        return [first, first + 0.95, last - 1.0, last]
    return [first, 0.5 * (first + last) + 0.02, last]


def _windows(car: CarTraits, lines: body.BodyLines, doors: list[float]) -> list[Decal]:
    waist, edge = (side[:, 2:0:-1] for side in (lines.waist, lines.edge))
    below, above = waist[[70, 84, 100, 110]] + (0.0, 0.035), edge[[105, 98, 88, 79, 72]] - (0.0, 0.05)
    corners = np.concatenate([below, above])
    corners[[4, 7, 8]] += [(-0.06, 0.0), (0.05, 0.0), (0.09, 0.03)]
    outline = corners + 0.035 * np.sign(corners - corners.mean(axis=0))
    decals = polygon(car.finish("outline", "trim"), outline) + polygon(car.finish("glass", "window"), corners)
    if car.has(["panel", "blind"]):  # a panel instead of windows
        right, top = outline.max(axis=0).tolist()
        return decals + box(car.finish("paint", "body"), doors[-1], float(outline[0, 1]), right, top)
    for at in doors[1:]:
        if corners[0, 0] + 0.2 < at < corners[3, 0] - 0.1:  # as high as the window is there
            ends = np.roll(corners, -1, axis=0)
            a, b = (each[(corners[:, 0] > at) != (ends[:, 0] > at)] for each in (corners, ends))
            v = a[:, 1] + (b[:, 1] - a[:, 1]) * (at - a[:, 0]) / (b[:, 0] - a[:, 0])
            post = car.finish("post colour", "post part")
            decals += box(post, at - 0.045, float(v.min()), at + 0.045, float(v.max()))
    return decals
