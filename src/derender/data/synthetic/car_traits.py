"""One car: its class, body style, measures, colours and fittings, drawn from a generator.

Twelve classes: seven body styles and five that differ by more than their body (police, ambulance, limousine,
jeep, sports). Measures are metres and, along the car, distance from the front bumper: a row of ``cars.yaml``
for each body style (typical outside measures of road cars, rounded) times small independent factors. Paint
is drawn from short lists of usual colours. Leaves out rust, dirt and damage; no existing car is drawn.
"""

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from derender.data.synthetic.decals import Colour
from derender.data.synthetic.settings import CLASSES

_WHITE, _BLACK = (0.92, 0.92, 0.91), (0.075, 0.075, 0.08)
_ALONG = (
    *("length", "front_wheel", "rear_wheel", "nose_at", "cowl_at", "screen_at"),
    *("roof_end_at", "deck_at", "tail_at"),
)
_UP = ("height", "nose", "cowl", "deck", "tail", "bumper")
_PLASTIC = {"suv": 0.6, "van": 0.6, "pickup": 0.6, "jeep": 1.0, "hatchback": 0.15}  # chance of such bumpers


@dataclass(frozen=True)
class CarShape:
    """One body, in metres. ``*_at`` lies along the car from its front; heights are from the ground."""

    length: float  # of the body without mirrors and what is mounted on it, as width and height
    width: float
    height: float
    sill: float  # height of the body's lower edge
    front_wheel: float  # where the axles are
    rear_wheel: float
    wheel: float  # radius of the wheels
    nose_at: float  # upper edge of the front face
    nose: float
    cowl_at: float  # where bonnet and windscreen meet
    cowl: float
    screen_at: float  # upper edge of the windscreen
    roof_end_at: float  # rear end of the roof, and how much lower it is than the height
    roof_drop: float
    deck_at: float  # lower edge of the rear window
    deck: float
    tail_at: float  # upper edge of the rear face
    tail: float
    bumper: float  # height of the foremost point
    tumblehome: float  # how much narrower the roof is on each side than the body at the windows' lower edge
    hood_inset: float  # how much narrower the bonnet's front is on each side than the body
    bow: float  # how far the front's corners stand back
    flare: float  # how far the wings stand out around the wheels
    soft: float  # 0..1, how far the profile's corners are rounded
    bed: float  # depth of an open bed or cabin behind the deck line; 0 is none


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
    chances: tuple[float, ...]  # ten uniform numbers that decide on fittings, each by its own position
    livery: int  # which of its class's liveries (police, ambulance, sports)

    @property
    def plastic(self) -> bool:
        """Whether the bumpers are of plastic rather than painted as the body."""
        return self.bumpers != self.paint


def draw_traits(name: str, generator: np.random.Generator) -> CarTraits:
    """A model of class ``name``. Draws the same number of random values whatever the class."""
    uniform = generator.random(24)
    spread = generator.standard_normal(8)
    style = CLASSES[name][int(uniform[0] * len(CLASSES[name]))]
    shape = _draw_shape(style, generator, 1.5 + 1.0 * uniform[1] if name == "limousine" else 0.0)
    livery = int(uniform[2] * 3)
    palettes = _numbers()["palettes"]
    paint = _spread(_pick(palettes.get(name, palettes["usual"]), uniform[3]), spread[:3])
    if name == "police":
        paint = (_BLACK, _WHITE, _WHITE)[livery]
    roof = paint
    if uniform[4] < {"suv": 0.3, "hatchback": 0.2}.get(name, 0.0):
        roof = _WHITE if sum(paint) < 1.4 else _BLACK
    if uniform[4] < {"sports": 0.25, "coupe": 0.25, "jeep": 0.6}.get(name, 0.0):
        roof = _BLACK if name != "jeep" or uniform[5] < 0.6 else _WHITE
    grey = 0.06 + 0.10 * uniform[6] + (0.08 if sum(paint) < 0.5 else 0.0)
    bright = 0.25 if uniform[8] < 0.2 else 0.55 + 0.25 * uniform[9]
    trim = 0.07 + 0.06 * uniform[10]
    plastic = (trim, trim, trim * 1.05)
    return CarTraits(
        name=name,
        style=style,
        shape=shape,
        paint=paint,
        roof=roof,
        glass=(grey, grey * (1.05 + 0.2 * uniform[7]), grey * (1.15 + 0.5 * uniform[7])),
        rim=(bright, bright, bright * 1.02),
        trim=plastic,
        bumpers=plastic if uniform[11] < _PLASTIC.get(name, 0.0) else paint,
        spokes=5 + int(uniform[12] * 4),
        chances=tuple(uniform[13:23].tolist()),
        livery=livery,
    )


@lru_cache(maxsize=1)
def _numbers() -> dict[str, Any]:
    return yaml.safe_load(Path(__file__).with_name("cars.yaml").read_text(encoding="utf-8"))


def _pick(palette: list[list[float]], share: float) -> Colour:
    ends = np.cumsum([weight for *_, weight in palette])
    red, green, blue, _ = palette[int(np.searchsorted(ends, share * ends[-1]))]
    return red, green, blue


def _spread(colour: Colour, by: np.ndarray) -> Colour:
    """The colour, a little lighter or darker (all channels) and of another tint (each channel)."""
    lighter = 1.0 + 0.10 * np.clip(by[0], -2, 2)
    moved = np.array(colour) * lighter * (1.0 + 0.05 * np.clip(by, -2, 2))
    red, green, blue = np.clip(moved, 0.03, 0.95).tolist()
    return red, green, blue


def _draw_shape(style: str, generator: np.random.Generator, stretch: float) -> CarShape:
    """A model of that style; ``stretch`` metres are put in behind the front doors (limousines)."""
    names = [f.name for f in fields(CarShape)]
    row = CarShape(*_numbers()["measures"][style])
    normal = np.clip(generator.standard_normal(len(names)), -2.0, 2.0)
    factor = {name: 1.0 + 0.03 * float(v) for name, v in zip(names, normal, strict=True)}
    drawn = {name: getattr(row, name) * factor[name] for name in names}
    for name in _ALONG:  # along the car one common factor, so that nothing changes places
        drawn[name] = getattr(row, name) * factor["length"]
    for name in _UP:
        drawn[name] = getattr(row, name) * factor["height"]
    between = factor["cowl"] - 1.0  # a longer or shorter bonnet moves the windscreen as a whole
    drawn["cowl_at"] += 1.2 * between
    drawn["screen_at"] += 1.2 * between + 2.0 * row.soft * (factor["screen_at"] - 1.0)
    if row.roof_end_at < row.deck_at - 0.25 and row.bed == 0.0:
        drawn["roof_end_at"] += 4.0 * row.soft * (factor["roof_end_at"] - 1.0)
    drawn["soft"] = min(1.0, row.soft * (1.0 + 5.0 * (factor["soft"] - 1.0)))
    drawn["bow"] = row.bow * (1.0 + 5.0 * (factor["bow"] - 1.0))
    drawn["nose"] *= 1.0 + (factor["nose"] - 1.0)
    if stretch:
        for name in ("length", "rear_wheel", "roof_end_at", "deck_at", "tail_at"):
            drawn[name] += stretch
    return CarShape(**drawn)
