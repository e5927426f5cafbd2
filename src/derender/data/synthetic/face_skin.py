"""The colour of a face (albedo free of shading) and the thickness of its hair, over the face's domain.

Skin tone with mottling, blush, freckles and stubble; lips; brows; hair with a hair line and strands; beard.
Eyes and the inside of the mouth change from picture to picture and are painted by face_features.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data.synthetic.face_grid import MOUTH_Q, FaceGrid, face_grid, smoothstep
from derender.data.synthetic.face_identity import SKIN_FIELDS, FaceIdentity

_FIELD_SEED = 7  # the noise fields are part of the model, the same for everyone; identities mix them


@dataclass(frozen=True)
class SkinBasis:
    """Fixed fields over the domain, between 0 and 1 or zero-mean."""

    mottling: Float[ndarray, "fields rows columns"]
    strands: Float[ndarray, "rows columns"]
    freckles: Float[ndarray, "rows columns"]
    grain: Float[ndarray, "rows columns"]
    blush: Float[ndarray, "rows columns"]
    under_eye: Float[ndarray, "rows columns"]
    lips: Float[ndarray, "rows columns"]
    beard: Float[ndarray, "rows columns"]
    nostrils: Float[ndarray, "rows columns"]
    ear: Float[ndarray, "rows columns"]


@lru_cache(maxsize=4)
def skin_basis(detail: float = 1.0) -> SkinBasis:
    grid = face_grid(detail)
    generator = np.random.default_rng(_FIELD_SEED)
    p, q, bump = np.abs(grid.p), grid.q, grid.bump
    freckle_noise = _waves(generator, grid, 60, 1.5, 2.3)
    cheeks_and_nose = np.maximum(bump((11.0, -2.0), (7.0, 4.5)), bump((0.0, -4.0), (4.0, 4.0)))
    return SkinBasis(
        mottling=np.stack([_waves(generator, grid, 10, 9.0, 24.0) for _ in range(SKIN_FIELDS)]),
        strands=_waves(generator, grid, 40, 1.4, 7.0, along=9.0),
        freckles=smoothstep(1.1, 1.9, freckle_noise) * cheeks_and_nose,
        grain=_waves(generator, grid, 40, 1.3, 2.6),
        blush=bump((13.0, 1.0), (5.5, 4.5)) + 0.55 * bump((0.0, -1.5), (3.2, 2.6)),
        under_eye=bump((10.8, -9.9), (4.3, 1.5)),
        lips=_lip_mask(p, q),
        beard=_beard_mask(p, q),
        nostrils=bump((2.3, 2.5), (0.95, 0.6)),
        ear=np.exp(-0.5 * (((np.abs(grid.theta) - 1.44) / 0.06) ** 2 + ((q + 3.0) / 4.0) ** 2)),
    )


def paint_skin(identity: FaceIdentity, detail: float = 1.0) -> tuple[ndarray, ndarray]:
    """Albedo (rows, columns, 3) and hair thickness (rows, columns) in face pixels."""
    grid, basis = face_grid(detail), skin_basis(detail)
    tone = (
        1.0
        + 0.028 * np.tensordot(identity.skin_noise, basis.mottling, 1) / np.sqrt(SKIN_FIELDS)
        + 0.012 * basis.grain
    )
    albedo = identity.skin * tone[..., None]
    redness = (0.4 + 0.6 * (1.0 - identity.melanin)) * identity.blush * basis.blush
    albedo *= 1.0 - redness[..., None] * np.array((0.01, 0.13, 0.12))
    albedo *= 1.0 - (0.10 + 0.12 * identity.age) * basis.under_eye[..., None] * np.array((0.8, 1.0, 0.85))
    albedo *= 1.0 - 0.28 * identity.freckles * basis.freckles[..., None] * np.array((0.7, 1.0, 1.15))
    albedo *= 1.0 - 0.16 * ear_share(identity) * basis.ear[..., None] * np.array((0.5, 1.0, 1.0))
    lips = identity.lips * (1.0 + 0.03 * basis.grain[..., None])
    albedo = _over(albedo, lips, 0.92 * basis.lips)
    albedo *= 1.0 - 0.6 * basis.nostrils[..., None] * np.array((0.85, 1.0, 1.0))
    stubble = identity.stubble * basis.beard * (1.0 - basis.lips) * (1.0 + 0.1 * basis.grain)
    albedo = _over(albedo, 0.35 * identity.hair + 0.35 * identity.skin, 0.5 * np.clip(stubble, 0.0, 1.0))
    strand_colour = identity.hair * (1.0 + 0.15 * basis.strands[..., None])
    beard = np.clip(identity.beard * basis.beard * (1.0 + 0.18 * basis.strands), 0.0, 1.0) * (
        1.0 - basis.lips
    )
    albedo = _over(albedo, strand_colour, 0.92 * smoothstep(0.05, 0.75, beard))
    albedo = _over(
        albedo, 0.85 * identity.hair + 0.05, identity.brow_strength * brow_mask(identity, grid, basis)
    )
    distance = hair_distance(identity, grid)
    distance = distance + 0.35 * basis.strands
    hair = smoothstep(-0.8, 0.8, distance)
    cover = {"bald": 0.0, "buzz": 0.75}.get(identity.hair_style, 1.0)
    albedo = _over(albedo, strand_colour, cover * hair)
    thickness = hair_thickness(identity, grid, distance) + 1.0 * smoothstep(0.35, 1.0, beard)
    return np.clip(albedo, 0.0, 1.0), thickness + 0.045 * basis.strands * np.clip(thickness, 0.0, 1.0)


def brow_mask(identity: FaceIdentity, grid: FaceGrid, basis: SkinBasis) -> ndarray:
    """Brows: an arch that is thickest at a third and tapers outwards, with a hairy edge."""
    p = np.abs(grid.p)
    along = np.clip((p - 4.6) / 13.2, 0.0, 1.0)
    centre = (
        -19.6 + 0.5 * (1.0 - along) - identity.brow_arch * 1.6 * np.sin(np.pi * along**1.25) + 1.3 * along**3
    )
    half = (
        identity.brow_thickness
        * 1.15
        * (0.75 + 0.5 * np.sin(np.pi * np.minimum(along * 1.3 + 0.1, 1.0)))
        * (1.0 - 0.65 * along**1.5)
    )
    edge = (half - np.abs(grid.q - centre)) / 0.7 + 0.12 * basis.grain
    ends = smoothstep(3.9, 6.2, p) * (1.0 - smoothstep(15.8, 18.6, p))
    return smoothstep(-0.6, 0.8, edge) * ends


def hair_distance(identity: FaceIdentity, grid: FaceGrid) -> ndarray:
    """How far a point lies inside the hair (> 0) or outside it, in face pixels, from the hair line's course.

    The line is given as the row ``q`` above which hair grows, at angles around the head.
    """
    style = identity.hair_style
    if style == "bald":
        return np.full(grid.shape, -50.0)
    turn = np.rad2deg(np.abs(grid.theta[0]))
    recede = 2.0 + 4.5 * identity.hair_recession
    front = -27.5 + identity.hair_line
    if style in ("bob", "long"):
        end = 22.0 if style == "bob" else 70.0
        at = (0.0, 22.0, 40.0, 52.0, 60.0, 66.0, 84.0, 96.0, 104.0, 115.0)
        line = np.array([front, front + 0.5, front + 4.0, front + 12.0, 2.0, end, end, end, end, end])
    else:
        at = (0.0, 24.0, 42.0, 58.0, 68.0, 76.0, 84.0, 96.0, 104.0, 115.0)
        line = np.array(
            [
                front + 1.0,
                front,
                front + 0.5 - recede,
                front + 7.0 - recede,
                -12.0,
                -2.5,
                -14.0,
                -10.0,
                9.0,
                18.0,
            ]
        )
    if style == "fringe" or (style == "bob" and identity.hair_line > 0.5):
        line[:4] = np.maximum(line[:4], np.array([-22.6, -23.2, -22.0, -16.0]) + 0.5 * identity.hair_line)
    limit = PchipInterpolator(at, line)(turn)
    sway, first, second, third = identity.hair_wave
    p = np.abs(grid.p[0])
    limit += (
        (0.2 + 0.6 * sway)
        * (np.sin(0.24 * p + 6.3 * first) + 0.6 * np.sin(0.55 * p + 6.3 * second))
        * np.exp(-((turn / 58.0) ** 6))
    )
    if style in ("fringe", "bob", "long"):
        depth = (3.0 + 2.0 * third) * identity.hair_parting * (0.4 if style == "fringe" else 1.0)
        limit -= depth * np.exp(-((p / 9.0) ** 2))
    slope = np.gradient(limit, grid.p[0])
    return (limit - grid.q) / np.sqrt(1.0 + slope**2)


def hair_thickness(identity: FaceIdentity, grid: FaceGrid, distance: ndarray) -> ndarray:
    """How far hair stands off the head, face pixels; hanging hair stands off the neck by more."""
    top = {"bald": 0.0, "buzz": 0.35, "short": 1.8, "fringe": 2.3, "bob": 2.6, "long": 2.2}[
        identity.hair_style
    ]
    side = {"bob": 2.6, "long": 2.6}.get(identity.hair_style, 0.0)
    hang = {"bob": 1.0, "long": 4.0}.get(identity.hair_style, 0.0)
    crown = 1.0 - smoothstep(-36.0, -12.0, grid.q)
    low = smoothstep(0.0, 34.0, grid.q)
    full = identity.hair_volume * (
        0.4 * top
        + 0.6 * top * crown
        + side * (1.0 - crown)
        + hang * (low + 1.2 * smoothstep(27.0, 37.0, grid.q))
    )
    return full * smoothstep(-0.3, 1.2 + 1.6 * np.maximum(full, 0.2), distance)


def ear_share(identity: FaceIdentity) -> float:
    """Size of the ears relative to the mean, 0 where hair covers them."""
    return 0.0 if identity.hair_style in ("bob", "long") else identity.ear_size


def _lip_mask(p: ndarray, q: ndarray) -> ndarray:
    arc = np.clip(1.0 - (p / 9.3) ** 2, 0.0, 1.0)
    top = MOUTH_Q - 2.9 * arc**0.9 + 0.55 * np.exp(-((p / 1.3) ** 2))
    bottom = MOUTH_Q + 3.5 * np.clip(1.0 - (p / 8.9) ** 2, 0.0, 1.0) ** 0.7
    return smoothstep(-0.45, 0.45, q - top) * smoothstep(-0.6, 0.6, bottom - q) * smoothstep(0.0, 0.08, arc)


def _beard_mask(p: ndarray, q: ndarray) -> ndarray:
    line = PchipInterpolator(
        [0.0, 3.0, 7.0, 10.0, 13.0, 17.0, 21.0, 24.0, 27.0, 31.0, 80.0],
        [18.8, 19.0, 18.2, 12.5, 10.0, 7.5, 3.0, -1.0, 6.0, 12.0, 12.0],
    )(p)
    cheeks = smoothstep(-2.5, 3.5, q - line) * (1.0 - smoothstep(33.0, 38.0, q))
    moustache = (
        np.exp(-(((q - 9.2 - 0.032 * p**2) / 2.3) ** 4))
        * np.exp(-((p / 10.5) ** 6))
        * (1.0 - 0.5 * np.exp(-((p / 1.2) ** 2)))
    )
    return np.maximum(cheeks, moustache)


def _over(under: ndarray, colour: ndarray, alpha: ndarray) -> ndarray:
    return under + (colour - under) * alpha[..., None]


def _waves(
    generator: np.random.Generator,
    grid: FaceGrid,
    count: int,
    shortest: float,
    longest: float,
    along: float | None = None,
) -> ndarray:
    """A smooth zero-mean field of unit variance: ``count`` plane waves with wavelengths in the given range
    (face pixels).

    With ``along`` the waves run sideways only, mirrored, and bend slowly over that length, like strands.
    """
    total = np.zeros(grid.shape)
    for _ in range(count):
        number = 2.0 * np.pi / generator.uniform(shortest, longest)
        phase, angle = generator.uniform(0, 2 * np.pi, 2)
        if along is None:
            total += np.cos(number * (np.cos(angle) * grid.p + np.sin(angle) * grid.q) + phase)
        else:
            bend = generator.uniform(0.3, 0.9) * np.sin(grid.q / along + angle)
            total += np.cos(number * (np.abs(grid.p) + bend) + phase)
    return total * np.sqrt(2.0 / count)
