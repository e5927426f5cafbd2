"""What one car is: its class, body style, measures, colours and fittings, drawn from a generator.

Twelve classes: seven body styles (sedan, hatchback, estate, suv, van, pickup, coupe) and five that are told
by more than their body: police, ambulance, limousine, jeep, sports. Paint is drawn from short lists of
usual colours with some spread; the lists and chances are ours. Leaves out rust, dirt and damage."""

from dataclasses import dataclass

import numpy as np

from derender.data.synthetic.car_decals import Colour
from derender.data.synthetic.car_shape import CarShape, draw_shape

CLASSES: dict[str, tuple[str, ...]] = {
    "sedan": ("sedan",),
    "hatchback": ("hatchback",),
    "estate": ("estate",),
    "suv": ("suv",),
    "van": ("van",),
    "pickup": ("pickup",),
    "coupe": ("coupe",),
    "police": ("sedan", "sedan", "estate", "suv"),
    "ambulance": ("cab",),
    "limousine": ("sedan",),
    "jeep": ("jeep_hard", "jeep_open"),
    "sports": ("sports",),
}

_WHITE, _BLACK = (0.92, 0.92, 0.91), (0.075, 0.075, 0.08)
_USUAL: tuple[tuple[Colour, float], ...] = (
    (_WHITE, 4), (_BLACK, 2.5), ((0.33, 0.34, 0.36), 2.5), ((0.66, 0.67, 0.68), 2.5), ((0.10, 0.22, 0.52), 2),
    ((0.18, 0.42, 0.72), 1.5), ((0.66, 0.07, 0.08), 2.5), ((0.40, 0.05, 0.09), 1), ((0.07, 0.26, 0.16), 1),
    ((0.36, 0.50, 0.30), 1), ((0.86, 0.42, 0.08), 1), ((0.88, 0.74, 0.14), 1), ((0.60, 0.50, 0.36), 1),
    ((0.24, 0.16, 0.11), 0.7), ((0.08, 0.42, 0.44), 1), ((0.38, 0.16, 0.42), 0.5),
)  # fmt: skip
_BRIGHT: tuple[tuple[Colour, float], ...] = (
    ((0.80, 0.05, 0.05), 4), ((0.95, 0.80, 0.06), 3), ((0.96, 0.45, 0.03), 2.5), ((0.45, 0.78, 0.10), 1.5),
    ((0.05, 0.30, 0.82), 2), ((0.08, 0.62, 0.86), 1), (_WHITE, 1), ((0.70, 0.72, 0.74), 0.7), (_BLACK, 0.5),
)  # fmt: skip
_RUGGED: tuple[tuple[Colour, float], ...] = (
    ((0.30, 0.34, 0.18), 3), ((0.68, 0.58, 0.40), 2.5), ((0.72, 0.08, 0.06), 1.5), ((0.93, 0.74, 0.10), 1.5),
    ((0.90, 0.44, 0.08), 1.5), ((0.12, 0.28, 0.50), 1.5), (_WHITE, 1), ((0.10, 0.30, 0.18), 1.5),
    ((0.5, 0.52, 0.54), 1),
)  # fmt: skip
_STATELY: tuple[tuple[Colour, float], ...] = (
    ((0.085, 0.085, 0.095), 4),
    (_WHITE, 4),
    ((0.62, 0.63, 0.66), 1.5),
)
_PALETTES = {"sports": _BRIGHT, "jeep": _RUGGED, "limousine": _STATELY, "ambulance": ((_WHITE, 1.0),)}


@dataclass(frozen=True)
class CarTraits:
    """One model.

    Attributes:
        name: its class.
        style: its body style.
        shape: its measures.
        paint, roof, glass, rim, trim: colours of body, roof, windows, wheels and plastic.
        bumpers: colour of the bumpers, the body's or the trim's.
        spokes: how many a wheel has.
        chances: ten uniform numbers that decide on fittings, each by its own position.
        livery: which of its class's liveries (police, ambulance, sports).
    """

    name: str
    style: str
    shape: CarShape
    paint: Colour
    roof: Colour
    glass: Colour
    rim: Colour
    trim: Colour
    bumpers: Colour
    spokes: int
    chances: tuple[float, ...]
    livery: int


def draw_traits(name: str, generator: np.random.Generator) -> CarTraits:
    """A model of class ``name``. Draws the same number of random values whatever the class."""
    uniform = generator.random(24)
    spread = generator.standard_normal(8)
    style = CLASSES[name][int(uniform[0] * len(CLASSES[name]))]
    stretch = 1.5 + 1.0 * uniform[1] if name == "limousine" else 0.0
    shape = draw_shape(style, generator, stretch)
    livery = int(uniform[2] * 3)
    paint = _spread(_pick(_PALETTES.get(name, _USUAL), uniform[3]), spread[:3])
    if name == "police":
        paint = (_BLACK, _WHITE, _WHITE)[livery]
    roof = paint
    if (name == "suv" and uniform[4] < 0.3) or (name == "hatchback" and uniform[4] < 0.2):
        roof = _WHITE if sum(paint) < 1.4 else _BLACK
    if name in ("sports", "coupe") and uniform[4] < 0.25:
        roof = _BLACK
    if name == "jeep" and uniform[4] < 0.6:
        roof = _BLACK if uniform[5] < 0.6 else _WHITE
    grey = 0.06 + 0.10 * uniform[6] + (0.08 if sum(paint) < 0.5 else 0.0)
    glass = (grey, grey * (1.05 + 0.2 * uniform[7]), grey * (1.15 + 0.5 * uniform[7]))
    bright = 0.25 if uniform[8] < 0.2 else 0.55 + 0.25 * uniform[9]
    trim = 0.07 + 0.06 * uniform[10]
    plastic = uniform[11] < {"suv": 0.6, "van": 0.6, "pickup": 0.6, "jeep": 1.0, "hatchback": 0.15}.get(
        name, 0.0
    )
    return CarTraits(
        name=name,
        style=style,
        shape=shape,
        paint=paint,
        roof=roof,
        glass=glass,
        rim=(bright, bright, bright * 1.02),
        trim=(trim, trim, trim * 1.05),
        bumpers=(trim, trim, trim * 1.05) if plastic else paint,
        spokes=5 + int(uniform[12] * 4),
        chances=tuple(uniform[13:23].tolist()),
        livery=livery,
    )


def _pick(palette: tuple[tuple[Colour, float], ...], share: float) -> Colour:
    weights = np.cumsum([weight for _, weight in palette])
    return palette[int(np.searchsorted(weights, share * weights[-1]))][0]


def _spread(colour: Colour, by: np.ndarray) -> Colour:
    """The colour, a little lighter or darker (all channels) and of another tint (each channel)."""
    lighter = 1.0 + 0.10 * np.clip(by[0], -2, 2)
    moved = np.array(colour) * lighter * (1.0 + 0.05 * np.clip(by, -2, 2))
    red, green, blue = np.clip(moved, 0.03, 0.95).tolist()
    return red, green, blue
