"""How faces differ: one symmetric displacement field per trait of shape, over the face's domain.

A coefficient of 1 is about one standard deviation among people. The last ones are marks of age.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from derender.data.synthetic.face_grid import EYE_P, EYE_Q, MOUTH_Q, FaceGrid, smoothstep


def identity_modes(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns 3"]]:
    """One symmetric displacement per name; a coefficient of 1 is one standard deviation among people."""
    p, q, bump = np.abs(grid.p), grid.q, grid.bump
    side = np.sin(grid.theta)
    zero = np.zeros(grid.shape)
    upper, lower = 1.0 - smoothstep(-18.0, 2.0, q), smoothstep(2.0, 22.0, q)
    face_only = 1.0 - smoothstep(31.0, 42.0, q)

    def field(x: ndarray = zero, y: ndarray = zero, z: ndarray = zero) -> ndarray:
        return np.stack([x, y, z], axis=-1)

    eye = bump((EYE_P, EYE_Q - 1.0), (6.5, 5.5))
    nose_area = bump((0.0, -3.0), (5.5, 6.5))
    mouth = bump((0.0, MOUTH_Q), (11.0, 5.0))
    sign = np.tanh(grid.p / 3.0)
    return {
        "skull_width": field(x=1.5 * side * upper),
        "face_width": field(x=1.2 * side * bump((20.0, -2.0), (30.0, 11.0))),
        "jaw_width": field(x=1.2 * side * lower * face_only),
        "jaw_corner": field(
            x=0.7 * side * bump((26.0, 20.0), (7.0, 7.0)), y=1.0 * bump((24.0, 22.0), (8.0, 7.0))
        ),
        "face_length": field(y=1.3 * smoothstep(0.0, 28.0, q) * (1.0 - smoothstep(40.0, 56.0, q))),
        "forehead_height": field(y=-1.6 * (1.0 - smoothstep(-36.0, -20.0, q))),
        "forehead_slope": field(
            z=1.6 * (1.0 - smoothstep(-36.0, -20.0, q)) * bump((0.0, -36.0), (20.0, 30.0))
        ),
        "forehead_bulge": field(z=-0.8 * bump((7.0, -28.0), (8.0, 5.0))),
        "brow_ridge": field(z=-0.9 * bump((9.0, -18.8), (6.5, 2.3)) - 0.5 * bump((0.0, -18.0), (4.0, 2.5))),
        "brow_height": field(y=-0.75 * bump((11.0, -20.0), (8.0, 2.6))),
        "eye_distance": field(x=0.7 * sign * eye),
        "eye_depth": field(z=0.8 * bump((11.5, -14.5), (5.5, 3.4))),
        "eye_height": field(y=-0.5 * eye),
        "cheekbones": field(
            z=-1.1 * bump((17.0, -4.0), (4.4, 3.6)), x=0.8 * side * bump((21.0, -4.0), (5.0, 4.0))
        ),
        "cheek_fullness": field(
            z=-1.5 * bump((14.5, 8.0), (5.0, 6.0)), x=0.9 * side * bump((22.0, 9.0), (7.0, 7.0))
        ),
        "nose_length": field(y=0.9 * bump((0.0, 0.0), (6.0, 4.5)), z=-0.3 * nose_area),
        "nose_width": field(
            x=0.75 * sign * bump((4.5, 0.2), (3.0, 3.2)), z=-0.25 * bump((4.8, 0.6), (1.5, 1.7))
        ),
        "nose_bridge": field(
            z=-1.0 * np.exp(-0.5 * (grid.p / 2.2) ** 2) * np.exp(-0.5 * ((q + 10.0) / 4.5) ** 2)
        ),
        "nose_hump": field(z=-0.6 * bump((0.0, -8.0), (1.7, 2.4))),
        "nose_tip": field(z=-1.3 * bump((0.0, -1.2), (2.6, 2.8)), y=0.15 * bump((0.0, -1.2), (2.6, 2.8))),
        "nose_turn": field(y=-0.9 * bump((0.0, -0.2), (3.0, 2.6)), z=-0.2 * bump((0.0, 1.0), (2.5, 2.0))),
        "nose_bulb": field(
            z=-0.5 * bump((1.6, -1.3), (1.1, 1.5)), x=0.35 * sign * bump((1.8, -1.3), (1.5, 1.7))
        ),
        "philtrum": field(y=0.8 * smoothstep(4.0, 11.0, q) * bump((0.0, 13.0), (11.0, 7.0))),
        "mouth_width": field(x=0.9 * np.tanh(grid.p / 5.0) * bump((8.0, MOUTH_Q), (5.0, 4.0))),
        "mouth_forward": field(z=-0.9 * mouth),
        "upper_lip": field(y=-0.45 * bump((0.0, 11.6), (6.5, 1.3)), z=-0.35 * bump((0.0, 12.4), (6.0, 1.1))),
        "lower_lip": field(y=0.55 * bump((0.0, 17.4), (5.5, 1.6)), z=-0.45 * bump((0.0, 16.3), (5.0, 1.3))),
        "chin_forward": field(z=-1.4 * bump((0.0, 25.5), (7.0, 5.0))),
        "chin_length": field(y=1.1 * bump((0.0, 28.0), (9.0, 5.0))),
        "chin_width": field(
            x=0.9 * sign * bump((6.0, 26.0), (6.0, 5.0)), z=-0.6 * bump((6.0, 26.0), (3.0, 3.0))
        ),
        "chin_cleft": field(z=0.25 * bump((0.0, 25.5), (0.9, 2.2))),
        "neck_width": field(x=1.3 * side * smoothstep(31.0, 40.0, q)),
        "temple": field(z=0.7 * bump((22.0, -20.0), (5.0, 6.0))),
        "under_eye": field(z=0.28 * bump((10.5, -9.3), (3.8, 1.0)) - 0.22 * bump((11.0, -11.2), (3.8, 0.8))),
        "fold": field(z=_fold(p, q)),
        "jowls": field(
            x=0.6 * side * bump((18.0, 24.0), (5.0, 5.0)),
            y=0.9 * bump((15.0, 23.0), (5.0, 5.0)),
            z=-0.7 * bump((13.0, 24.0), (3.0, 3.5)) + 0.5 * bump((7.5, 24.5), (1.4, 3.5)),
        ),
        "forehead_lines": field(z=_forehead_lines(grid)),
        "crows_feet": field(z=_crows_feet(p, q)),
    }


def wrinkles(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns"]]:
    """Where the lines of age lie, 0..1, for colouring them."""
    p, q = np.abs(grid.p), grid.q
    return {
        "fold": np.clip(_fold(p, q) / 0.3, 0.0, 1.0),
        "forehead_lines": np.clip(_forehead_lines(grid) / 0.12, 0.0, 1.0),
        "crows_feet": np.clip(_crows_feet(p, q) / 0.16, 0.0, 1.0),
        "under_eye": grid.bump((10.5, -9.2), (4.0, 0.8)),
    }


def _forehead_lines(grid: FaceGrid) -> ndarray:
    wave = np.sin(2.0 * np.pi * (grid.q + 25.0 + 0.5 * np.cos(grid.p / 6.0)) / 3.1)
    return 0.12 * wave * np.exp(-(((grid.q + 26.0) / 4.6) ** 4)) * np.exp(-((grid.p / 15.0) ** 4))


def _crows_feet(p: ndarray, q: ndarray) -> ndarray:
    away, level = p - 17.4, q - EYE_Q
    fan = np.arctan2(level, np.maximum(away, 0.05) + 1.5)
    return 0.16 * np.sin(9.0 * fan) * np.exp(-(((away - 2.2) / 2.4) ** 4)) * np.exp(-((level / 3.6) ** 4))


def _fold(p: ndarray, q: ndarray) -> ndarray:
    """The crease from the nose's wing to the mouth's corner."""
    along = np.clip((q - 0.5) / 11.5, 0.0, 1.0)
    centre = 6.3 + 4.6 * along**0.8
    depth = np.exp(-0.5 * ((p - centre) / 1.1) ** 2) - 0.6 * np.exp(-0.5 * ((p - centre - 2.4) / 1.8) ** 2)
    return 0.3 * depth * np.exp(-(((q - 6.5) / 6.5) ** 4))
