"""The measures of a car: one row of plain numbers a body style, and what one model draws from it.

Metres and, along the car, distance from the front bumper. The rows are typical outside measures of road
cars, rounded; a model is its style's row times small independent factors. Leaves out make and model: no
existing car is drawn.
"""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class CarShape:
    """One body, in metres. ``*_at`` lies along the car from its front; heights are from the ground.

    Attributes:
        length, width, height: of the body without mirrors and what is mounted on it.
        sill: height of the body's lower edge.
        front_wheel, rear_wheel: where the axles are.
        wheel: radius of the wheels.
        nose_at, nose: upper edge of the front face.
        cowl_at, cowl: where bonnet and windscreen meet.
        screen_at: upper edge of the windscreen.
        roof_end_at, roof_drop: rear end of the roof, and how much lower it is than the height.
        deck_at, deck: lower edge of the rear window.
        tail_at, tail: upper edge of the rear face.
        bumper: height of the foremost point.
        tumblehome: how much narrower the roof is on each side than the body at the windows' lower edge.
        hood_inset: how much narrower the bonnet's front is on each side than the body.
        bow: how far the front's corners stand back.
        flare: how far the wings stand out around the wheels.
        soft: 0..1, how far the profile's corners are rounded.
        bed: depth of an open bed or cabin behind the deck line; 0 is none.
    """

    length: float
    width: float
    height: float
    sill: float
    front_wheel: float
    rear_wheel: float
    wheel: float
    nose_at: float
    nose: float
    cowl_at: float
    cowl: float
    screen_at: float
    roof_end_at: float
    roof_drop: float
    deck_at: float
    deck: float
    tail_at: float
    tail: float
    bumper: float
    tumblehome: float
    hood_inset: float
    bow: float
    flare: float
    soft: float
    bed: float


# in the order of the attributes: length width height sill, wheels, nose, cowl, screen, roof, deck, tail,
# bumper, tumblehome, hood_inset, bow, flare, soft, bed
_ROWS: dict[str, tuple[float, ...]] = {
    "sedan": (4.60, 1.82, 1.45, 0.22, 0.92, 3.62, 0.33, 0.10, 0.70, 1.32, 0.97, 2.05, 3.10, 0.03, 3.82, 1.04,
              4.50, 0.99, 0.50, 0.20, 0.06, 0.26, 0.02, 0.75, 0.0),
    "hatchback": (3.95, 1.75, 1.50, 0.22, 0.82, 3.30, 0.32, 0.10, 0.74, 1.08, 1.00, 1.72, 3.25, 0.05, 3.78,
                  1.04, 3.88, 0.95, 0.50, 0.20, 0.06, 0.28, 0.02, 0.85, 0.0),
    "estate": (4.70, 1.82, 1.50, 0.22, 0.93, 3.65, 0.33, 0.10, 0.70, 1.30, 0.97, 2.00, 4.15, 0.05, 4.55, 1.00,
               4.64, 0.92, 0.50, 0.19, 0.06, 0.26, 0.02, 0.70, 0.0),
    "suv": (4.60, 1.92, 1.78, 0.34, 0.92, 3.62, 0.39, 0.08, 0.98, 1.28, 1.18, 1.92, 4.00, 0.05, 4.42, 1.18,
            4.52, 1.10, 0.62, 0.19, 0.05, 0.22, 0.03, 0.60, 0.0),
    "van": (4.90, 1.96, 2.02, 0.26, 0.88, 3.85, 0.34, 0.08, 0.92, 0.78, 1.18, 1.50, 4.70, 0.03, 4.84, 1.18,
            4.88, 1.05, 0.52, 0.15, 0.05, 0.26, 0.02, 0.55, 0.0),
    "pickup": (5.30, 1.92, 1.80, 0.38, 0.95, 4.05, 0.40, 0.07, 1.00, 1.40, 1.18, 2.05, 3.05, 0.04, 3.22, 1.16,
               5.24, 1.16, 0.62, 0.18, 0.04, 0.18, 0.03, 0.45, 0.50),
    "coupe": (4.45, 1.82, 1.34, 0.20, 0.93, 3.52, 0.34, 0.12, 0.66, 1.42, 0.92, 2.18, 2.75, 0.03, 3.92, 0.98,
              4.36, 0.94, 0.46, 0.24, 0.07, 0.30, 0.03, 0.90, 0.0),
    "sports": (4.45, 1.98, 1.17, 0.15, 0.98, 3.58, 0.35, 0.30, 0.52, 1.22, 0.80, 2.12, 2.62, 0.02, 3.55, 0.90,
               4.36, 0.86, 0.34, 0.27, 0.10, 0.30, 0.06, 1.00, 0.0),
    "jeep_hard": (3.95, 1.56, 1.84, 0.46, 0.66, 3.18, 0.42, 0.03, 1.10, 1.32, 1.20, 1.56, 3.86, 0.02, 3.90,
                  1.20, 3.92, 1.10, 0.66, 0.07, 0.10, 0.05, 0.00, 0.18, 0.0),
    "jeep_open": (3.95, 1.56, 1.21, 0.46, 0.66, 3.18, 0.42, 0.03, 1.10, 1.32, 1.20, 1.37, 1.42, 0.00, 1.47,
                  1.20, 3.90, 1.19, 0.66, 0.00, 0.10, 0.05, 0.00, 0.16, 0.62),
    "cab": (5.20, 1.96, 1.95, 0.36, 0.90, 4.05, 0.39, 0.08, 0.98, 1.05, 1.20, 1.62, 2.55, 0.03, 2.62, 1.20,
            5.15, 0.78, 0.56, 0.17, 0.05, 0.20, 0.02, 0.50, 0.0),
}  # fmt: skip

STYLES: dict[str, CarShape] = {name: CarShape(*row) for name, row in _ROWS.items()}
_ALONG = (
    "length", "front_wheel", "rear_wheel", "nose_at", "cowl_at", "screen_at", "roof_end_at", "deck_at",
    "tail_at",
)  # fmt: skip
_UP = ("height", "nose", "cowl", "deck", "tail", "bumper")


def draw_shape(style: str, generator: np.random.Generator, stretch: float = 0.0) -> CarShape:
    """A model of that style; ``stretch`` metres are put in behind the front doors (limousines)."""
    row = STYLES[style]
    factor = {f.name: 1.0 + 0.03 * float(v) for f, v in zip(fields(row), _bounded(generator), strict=True)}
    drawn = {name: getattr(row, name) * factor[name] for name in factor}
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
    shape = CarShape(**drawn)
    return stretched(shape, stretch) if stretch else shape


def stretched(shape: CarShape, by: float) -> CarShape:
    """The same car, longer by ``by`` metres between its doors."""
    moved = ("length", "rear_wheel", "roof_end_at", "deck_at", "tail_at")
    return replace(shape, **{name: getattr(shape, name) + by for name in moved})


def _bounded(generator: np.random.Generator) -> np.ndarray:
    return np.clip(generator.standard_normal(len(fields(CarShape))), -2.0, 2.0)
