"""Muscle actions as displacement fields, and the seven named expressions as weights of them.

The names follow facial action coding loosely; skin (brows, lips) is attached to the surface and moves with
it, while the lids are drawn by face_features from the weights ``wide`` and ``squint``. Each action comes as
a left and a right half so that a little asymmetry is possible. Leaves out the tongue's motion, blinks, and
puckered lips.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray

from derender.data.synthetic.face_grid import MOUTH_BAND, MOUTH_Q, FaceGrid, face_grid, smoothstep

ACTIONS = (
    "jaw_open", "lips_part", "smile", "cheek_raise", "frown", "stretch", "sneer", "press",
    "brow_inner_up", "brow_outer_up", "brow_lower",
)  # fmt: skip
LID_ACTIONS = ("wide", "squint")
_TOO_LITTLE = 0.002  # face pixels

EXPRESSIONS: dict[str, dict[str, float]] = {
    "neutral": {},
    "happiness": {"smile": 1.0, "cheek_raise": 0.9, "lips_part": 0.75, "squint": 0.45, "stretch": 0.2},
    "sadness": {"brow_inner_up": 1.0, "frown": 0.85, "brow_lower": 0.25, "squint": 0.4},
    "surprise": {"jaw_open": 1.0, "stretch": -0.6, "brow_inner_up": 0.9, "brow_outer_up": 1.0, "wide": 0.9},
    "anger": {"brow_lower": 1.15, "press": 0.8, "squint": 0.3, "sneer": 0.3, "frown": 0.45},
    "disgust": {
        "sneer": 1.1,
        "brow_lower": 0.6,
        "squint": 0.6,
        "frown": 0.5,
        "cheek_raise": 0.6,
        "lips_part": 0.25,
    },
    "fear": {
        "brow_inner_up": 1.0,
        "brow_outer_up": 0.5,
        "wide": 0.9,
        "stretch": 1.0,
        "lips_part": 0.6,
        "jaw_open": 0.25,
    },
}


@dataclass(frozen=True)
class ExpressionBasis:
    """``fields`` (actions, 2 sides, rows, columns, 3): displacement by each action's left and right half;
    ``boxes`` (actions, 2, 4): the rows and columns (first, last exclusive) where it moves anything."""

    fields: Float[ndarray, "actions two rows columns 3"]
    boxes: Int64[ndarray, "actions two 4"]


@lru_cache(maxsize=4)
def expression_basis(detail: float = 1.0) -> ExpressionBasis:
    grid = face_grid(detail)
    left = 1.0 - smoothstep(-4.0, 4.0, grid.p)
    fields = np.stack([action_fields(grid)[name] for name in ACTIONS])
    halves = np.stack([fields * left[..., None], fields * (1.0 - left)[..., None]], axis=1)
    halves[np.abs(halves) < _TOO_LITTLE] = 0.0
    boxes = np.array([[_box(np.abs(half).max(axis=-1) > 0) for half in pair] for pair in halves], np.int64)
    return ExpressionBasis(halves.astype(np.float32), boxes)


def _box(moved: ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(moved.any(axis=1)), np.flatnonzero(moved.any(axis=0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def action_fields(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns 3"]]:
    """Each action at full strength."""
    p, q, bump = np.abs(grid.p), grid.q, grid.bump
    sign = np.tanh(grid.p / 2.0)
    zero = np.zeros(grid.shape)

    def field(x: ndarray = zero, y: ndarray = zero, z: ndarray = zero) -> ndarray:
        return np.stack([x, y, z], axis=-1)

    below_line = smoothstep(MOUTH_Q - MOUTH_BAND, MOUTH_Q + MOUTH_BAND, q)
    lens = np.sqrt(np.clip(1.0 - (p / 9.2) ** 2, 0.0, 1.0))
    upper_side = (1.0 - below_line) * lens * np.exp(-0.5 * ((q - MOUTH_Q) / 3.0) ** 2)
    lower_side = below_line * lens * np.exp(-0.5 * ((q - MOUTH_Q) / 4.0) ** 2)
    inside = np.exp(-((np.abs(q - MOUTH_Q) / (0.9 * MOUTH_BAND)) ** 4)) * lens
    hinge = np.exp(-((p / 24.0) ** 4)) * (1.0 - smoothstep(33.0, 52.0, q))
    drop = ((1.0 - lens) * smoothstep(5.0, 25.0, q) + lens * below_line) * hinge
    corner = bump((9.2, MOUTH_Q), (4.2, 4.2))
    cheek = bump((14.0, 4.0), (4.2, 3.6))
    fold = _fold(p, q)
    brow = np.exp(-0.5 * ((q + 20.0) / 3.6) ** 2)
    inner = np.exp(-(((p - 3.0) / 6.5) ** 2)) * brow
    wrinkle = (
        np.sin(2.0 * np.pi * (q + 25.0) / 2.6)
        * np.exp(-(((q + 24.3) / 2.6) ** 4))
        * np.exp(-((p / 13.0) ** 4))
    )
    return {
        "jaw_open": field(
            x=-0.09 * grid.p * smoothstep(4.0, 18.0, q) * hinge, y=9.0 * drop, z=2.2 * drop + 4.5 * inside
        ),
        "lips_part": field(y=-1.6 * upper_side + 2.0 * lower_side, z=1.6 * inside),
        "smile": field(
            x=sign * 2.6 * corner,
            y=-3.4 * corner - 0.6 * bump((0.0, 15.0), (6.0, 4.0)) + 0.7 * upper_side,
            z=1.3 * corner + 1.3 * fold,
        ),
        "cheek_raise": field(y=-1.1 * cheek, z=-1.7 * cheek + 0.45 * bump((11.0, -9.0), (5.0, 1.0))),
        "frown": field(
            x=sign * 0.4 * corner,
            y=2.4 * corner - 0.9 * bump((0.0, 17.0), (4.5, 3.5)),
            z=0.7 * fold - 0.8 * bump((0.0, 23.0), (4.0, 2.5)) + 0.5 * bump((11.0, 18.0), (1.3, 2.4)),
        ),
        "stretch": field(x=sign * 2.6 * corner, y=0.9 * corner + 0.5 * lower_side, z=0.9 * corner),
        "sneer": field(
            y=-1.7 * upper_side - 1.2 * bump((0.0, 10.5), (6.0, 2.5)) - 1.1 * bump((4.3, 0.6), (2.2, 2.4)),
            z=1.4 * fold
            - 0.5 * bump((4.3, 0.6), (1.6, 1.8))
            + 0.22 * np.sin(2.0 * np.pi * (q + 11.0) / 3.0) * bump((0.0, -11.0), (2.6, 2.6)),
        ),
        "press": field(
            y=0.7 * bump((0.0, 12.0), (7.5, 1.2)) - 0.8 * bump((0.0, 16.4), (6.5, 1.4)),
            z=0.9 * bump((0.0, 13.9), (7.0, 2.0)) - 0.5 * bump((0.0, 23.0), (4.5, 3.0)),
        ),
        "brow_inner_up": field(y=-2.8 * inner, z=0.2 * wrinkle * np.exp(-((p / 9.0) ** 4))),
        "brow_outer_up": field(y=-2.8 * bump((14.5, -20.0), (5.5, 3.6)), z=0.2 * wrinkle),
        "brow_lower": field(
            x=-sign * 0.9 * bump((6.0, -19.5), (4.0, 3.0)),
            y=2.3 * np.exp(-(((p - 5.0) / 7.0) ** 2)) * brow,
            z=-0.9 * bump((7.0, -18.5), (5.0, 1.8))
            + 0.9 * bump((2.0, -19.0), (0.7, 2.6))
            - 0.4 * bump((0.0, -19.0), (1.0, 2.6)),
        ),
    }


def _fold(p: ndarray, q: ndarray) -> ndarray:
    """The crease between cheek and upper lip that a smile deepens."""
    centre = 6.3 + 5.6 * np.clip((q - 0.5) / 11.5, 0.0, 1.0) ** 0.8
    depth = 0.8 * np.exp(-0.5 * ((p - centre) / 1.1) ** 2) - 0.6 * np.exp(
        -0.5 * ((p - centre - 2.4) / 1.8) ** 2
    )
    return 0.75 * depth * np.exp(-(((q - 6.5) / 6.5) ** 4))
