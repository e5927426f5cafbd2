"""The colour of a face (albedo free of shading), the thickness of its hair, and its parts.

Skin tone with mottling, blush, freckles, lines of age and stubble; lips; brows; hair; beard; clothes. Eyes
and the inside of the mouth change from picture to picture and are painted by face_features.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from derender.data.celebamask import MASK_CLASSES
from derender.data.synthetic.face_grid import MOUTH_Q, FaceGrid, face_grid, smoothstep
from derender.data.synthetic.face_hair import (
    BEARDS,
    HAIR_STYLES,
    beard_amount,
    hair_distance,
    hair_forward,
    hair_thickness,
)
from derender.data.synthetic.face_identity import SKIN_FIELDS, FaceIdentity
from derender.data.synthetic.face_modes import wrinkles
from derender.data.synthetic.face_shape import bare_head

PART = {name: np.uint8(number) for number, name in enumerate(MASK_CLASSES)}
_BROW_ROWS = (-27.0, -14.0)
_FIELD_SEED = 7  # the noise fields are part of the model, the same for everyone; identities mix them


@dataclass(frozen=True)
class SkinBasis:
    """Fixed fields over the domain, between 0 and 1 or zero-mean, and the parts that never move."""

    mottling: Float[ndarray, "fields rows columns"]
    strands: Float[ndarray, "rows columns"]
    curls: Float[ndarray, "rows columns"]
    freckles: Float[ndarray, "rows columns"]
    grain: Float[ndarray, "rows columns"]
    blush: Float[ndarray, "rows columns"]
    under_eye: Float[ndarray, "rows columns"]
    lines: dict[str, Float[ndarray, "rows columns"]]
    lips: Float[ndarray, "rows columns"]
    beards: dict[str, Float[ndarray, "rows columns"]]
    nostrils: Float[ndarray, "rows columns"]
    ear: Float[ndarray, "rows columns"]
    parts: ndarray
    is_ear: ndarray
    reach: ndarray  # (rows, 1) half width of the bare head


@dataclass(frozen=True)
class Skin:
    """One person's surface: ``albedo`` (rows, columns, 3) 0..1; ``thickness`` of hair and clothes and how far
    hair hangs ``forward`` (rows, columns) in face pixels; ``parts`` as numbers into MASK_CLASSES."""

    albedo: ndarray
    thickness: ndarray
    forward: ndarray
    parts: ndarray


@lru_cache(maxsize=4)
def skin_basis(detail: float = 1.0) -> SkinBasis:
    grid = face_grid(detail)
    generator = np.random.default_rng(_FIELD_SEED)
    p, q, bump = np.abs(grid.p), grid.q, grid.bump
    freckle_noise = _waves(generator, grid, 60, 1.5, 2.3)
    cheeks_and_nose = np.maximum(bump((11.0, -2.0), (7.0, 4.5)), bump((0.0, -4.0), (4.0, 4.0)))
    lips = _lip_mask(p, q)
    is_ear = _is_ear(grid)
    basis = SkinBasis(
        mottling=np.stack([_waves(generator, grid, 10, 9.0, 24.0) for _ in range(SKIN_FIELDS)]).astype(
            np.float32
        ),
        strands=_waves(generator, grid, 40, 1.4, 7.0, along=9.0),
        curls=_waves(generator, grid, 50, 3.5, 7.0),
        freckles=smoothstep(1.1, 1.9, freckle_noise) * cheeks_and_nose,
        grain=_waves(generator, grid, 40, 1.3, 2.6),
        blush=bump((13.0, 1.0), (5.5, 4.5)) + 0.55 * bump((0.0, -1.5), (3.2, 2.6)),
        under_eye=bump((10.8, -9.9), (4.3, 1.5)),
        lines=wrinkles(grid),
        lips=lips,
        beards={kind: beard_amount(grid, kind) * (1.0 - lips) for kind in BEARDS},
        nostrils=bump((2.4, 3.3), (1.05, 0.6)),
        ear=np.exp(-0.5 * (((np.abs(grid.theta) - 1.44) / 0.06) ** 2 + ((q + 3.0) / 4.0) ** 2)),
        parts=_fixed_parts(grid, lips, is_ear),
        is_ear=is_ear,
        reach=np.abs(bare_head(grid)[..., 0]).max(axis=1, keepdims=True),
    )
    return SkinBasis(**{name: _single(value) for name, value in vars(basis).items()})


def _single(value: Any) -> Any:
    """The same in single precision, which is all that colours need."""
    if isinstance(value, dict):
        return {name: _single(field) for name, field in value.items()}
    return value.astype(np.float32) if value.dtype == np.float64 else value


def paint_skin(identity: FaceIdentity, detail: float = 1.0) -> Skin:
    grid, basis = face_grid(detail), skin_basis(detail)
    albedo = _bare_skin(identity, basis)
    parts = basis.parts.copy()
    beard = basis.beards[identity.beard]
    strand_colour = _rgb(identity.hair) * (
        1.0 + 0.09 * basis.strands[..., None] + 0.05 * basis.mottling[0][..., None]
    )
    if identity.beard == "stubble":
        shade = _rgb(0.35 * identity.hair + 0.40 * identity.skin)
        albedo = _over(albedo, shade, np.clip(0.5 * beard * (1.0 + 0.1 * basis.grain), 0.0, 1.0))
        thickness = np.zeros(grid.shape)
    else:
        rough = np.clip(beard * (1.0 + 0.2 * basis.strands), 0.0, 1.0)
        albedo = _over(albedo, 0.9 * strand_colour, 0.9 * smoothstep(0.1, 0.8, rough))
        length = {"full beard": 1.7, "short beard": 0.6}.get(identity.beard, 0.9)
        thickness = length * smoothstep(0.3, 1.0, rough) * (1.0 + 0.06 * basis.strands)
    brow = brow_mask(identity, grid, basis)
    albedo = _over(albedo, _rgb(0.85 * identity.hair + 0.04), identity.brow_strength * brow)
    parts[(brow > 0.5) & (grid.p > 0)] = PART["l_brow"]
    parts[(brow > 0.5) & (grid.p < 0)] = PART["r_brow"]
    collar = identity.collar + 0.012 * grid.p**2 - 8.0 * smoothstep(0.5, 2.0, np.abs(grid.theta))
    cloth = smoothstep(-0.4, 0.4, grid.q - collar)
    albedo = _over(albedo, _rgb(identity.cloth), cloth)
    parts[cloth > 0.5] = PART["cloth"]
    thickness = thickness + 1.2 * cloth
    style = HAIR_STYLES[identity.hair_style]
    distance = hair_distance(
        grid, style, identity.hair_line, identity.hair_recession, identity.hair_parting, identity.hair_wave
    )
    distance = distance + 0.5 * basis.strands + 0.9 * style.curl * basis.curls
    hair = style.cover * smoothstep(-0.8, 0.9 if style.fall > 2.0 or style.side > 1.5 else 2.2, distance)
    if not style.covers_ears:
        hair = hair * (1.0 - basis.is_ear)
    root = 1.0 - 0.25 * smoothstep(0.0, 3.0, 3.0 - np.abs(distance))[..., None]
    albedo = _over(albedo, strand_colour * (1.0 + 0.10 * style.curl * basis.curls[..., None]) * root, hair)
    parts[hair > 0.5] = PART["hair"]
    lift = hair_thickness(grid, style, identity.hair_volume, distance, basis.reach)
    lift = lift * (1.0 + style.curl * 0.22 * basis.curls) + 0.03 * basis.strands * np.clip(lift, 0.0, 1.5)
    if not style.covers_ears:
        lift = lift * (1.0 - basis.is_ear)
    return Skin(
        np.clip(albedo, 0.0, 1.0).astype(np.float32),
        np.maximum(thickness, lift).astype(np.float32),
        hair_forward(grid, style, distance).astype(np.float32),
        parts,
    )


def _bare_skin(identity: FaceIdentity, basis: SkinBasis) -> ndarray:
    age = identity.age
    tone = (
        1.0
        + (0.022 + 0.016 * age)
        * np.tensordot(_rgb(identity.skin_noise), basis.mottling, 1)
        / np.sqrt(SKIN_FIELDS)
        + (0.010 + 0.012 * age) * basis.grain
    )
    albedo = _rgb(identity.skin) * tone[..., None]
    redness = (0.4 + 0.6 * (1.0 - identity.melanin)) * identity.blush * basis.blush
    albedo *= 1.0 - redness[..., None] * _rgb((0.01, 0.12, 0.11))
    albedo *= 1.0 - (0.08 + 0.14 * age) * basis.under_eye[..., None] * _rgb((0.8, 1.0, 0.85))
    albedo *= 1.0 - 0.28 * identity.freckles * basis.freckles[..., None] * _rgb((0.7, 1.0, 1.15))
    albedo *= 1.0 - 0.16 * ear_share(identity) * basis.ear[..., None] * _rgb((0.5, 1.0, 1.0))
    deep = max(0.0, age - 0.25)
    strength = {"fold": 0.30, "forehead_lines": 0.16, "crows_feet": 0.26, "under_eye": 0.16}
    lines = sum(strength[name] * field for name, field in basis.lines.items())
    albedo *= 1.0 - np.clip(deep * lines, 0.0, 0.5)[..., None] * _rgb((0.85, 1.0, 1.0))
    lips = _rgb(identity.lips) * (1.0 + 0.03 * basis.grain[..., None])
    albedo = _over(albedo, lips, 0.9 * basis.lips)
    return albedo * (1.0 - 0.6 * basis.nostrils[..., None] * _rgb((0.85, 1.0, 1.0)))


def brow_mask(identity: FaceIdentity, grid: FaceGrid, basis: SkinBasis) -> ndarray:
    """Brows: an arch that is thickest at a third and tapers outwards, with a hairy edge."""
    mask = np.zeros(grid.shape, np.float32)
    rows = slice(*np.searchsorted(grid.q[:, 0], _BROW_ROWS))
    p, q = np.abs(grid.p[rows]), grid.q[rows]
    along = np.clip((p - 4.6) / 13.2, 0.0, 1.0)
    centre = (
        -19.8 + 0.5 * (1.0 - along) - identity.brow_arch * 1.6 * np.sin(np.pi * along**1.25) + 1.3 * along**3
    )
    half = (
        identity.brow_thickness
        * 1.15
        * (0.75 + 0.5 * np.sin(np.pi * np.minimum(along * 1.3 + 0.1, 1.0)))
        * (1.0 - 0.65 * along**1.5)
    )
    edge = (half - np.abs(q - centre)) / 0.7 + 0.12 * basis.grain[rows]
    ends = smoothstep(3.9, 6.2, p) * (1.0 - smoothstep(15.8, 18.6, p))
    mask[rows] = smoothstep(-0.6, 0.8, edge) * ends
    return mask


def ear_share(identity: FaceIdentity) -> float:
    """Size of the ears relative to the mean, 0 where hair covers them."""
    return 0.0 if HAIR_STYLES[identity.hair_style].covers_ears else identity.ear_size


def _fixed_parts(grid: FaceGrid, lips: ndarray, is_ear: ndarray) -> ndarray:
    """Skin, nose, ears, lips and neck, left and right being the person's own."""
    p, q = np.abs(grid.p), grid.q
    parts = np.full(grid.shape, PART["skin"])
    width = np.interp(q, [-13.0, -6.0, -2.5, 0.0, 2.5, 4.0], [2.2, 3.4, 5.2, 6.4, 5.8, 3.0])
    parts[(q > -13.0) & (q < 4.0) & (p < width)] = PART["nose"]
    parts[is_ear & (grid.p > 0)] = PART["l_ear"]
    parts[is_ear & (grid.p < 0)] = PART["r_ear"]
    parts[(q > 32.0) & ~is_ear] = PART["neck"]
    parts[(lips > 0.5) & (q <= MOUTH_Q)] = PART["u_lip"]
    parts[(lips > 0.5) & (q > MOUTH_Q)] = PART["l_lip"]
    return parts


def _is_ear(grid: FaceGrid) -> ndarray:
    """Where face_shape.ear folds an ear out of the head."""
    middle = grid.q + 5.5
    slant = np.deg2rad(86.0) - np.deg2rad(0.35) * middle
    away = np.abs(grid.theta) - slant
    return (np.abs(middle) < 7.6) & (away > -0.14) & (away < 0.2)


def _lip_mask(p: ndarray, q: ndarray) -> ndarray:
    arc = np.clip(1.0 - (p / 9.3) ** 2, 0.0, 1.0)
    top = MOUTH_Q - 2.9 * arc**0.9 + 0.55 * np.exp(-((p / 1.3) ** 2))
    bottom = MOUTH_Q + 3.6 * np.clip(1.0 - (p / 8.9) ** 2, 0.0, 1.0) ** 0.7
    return smoothstep(-0.45, 0.45, q - top) * smoothstep(-0.6, 0.6, bottom - q) * smoothstep(0.0, 0.08, arc)


def _rgb(values: Any) -> ndarray:
    return np.asarray(values, np.float32)


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
