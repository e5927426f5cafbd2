"""The colour of a face (albedo free of shading), its parts, and the hair that grows on it.

Skin tone with mottling, blush, freckles, lines of age and stubble; lips; brows; hair; beard; clothes. Hair is
part of the head's surface: it grows above a line around the head, given as a row ``q`` for each angle, and
lifts the surface by its thickness, with a soft, uneven edge. Eyes and the inside of the mouth change from
image to image and are painted by ``face_mesh``. Leaves out single strands, plaits, and hair that hangs free
of the head.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data import MASK_CLASSES
from derender.data.synthetic.face_identity import (
    BEARDS,
    CURTAIN,
    HAIR_STYLES,
    SKIN_FIELDS,
    FaceIdentity,
    HairStyle,
)
from derender.data.synthetic.face_shape import (
    MOUTH_Q,
    FaceGrid,
    bare_head,
    ear_slant,
    face_grid,
    hill,
    smoothstep,
    wrinkles,
)

PART = {name: np.uint8(number) for number, name in enumerate(MASK_CLASSES)}
_BROW_ROWS = (-27.0, -14.0)
_FIELD_SEED = 7  # the noise fields are part of the model, the same for everyone; identities mix them
_HANG = 27.5  # half width at which hair falls past jaw and neck
_TURNS_DEG = (0.0, 15.0, 30.0, 42.0, 50.0, 57.0, 63.0, 70.0, 78.0, 86.0, 96.0, 104.0, 115.0)
_BEARD_LINE = np.array([  # where beards begin on the cheek: p, q
    (0.0, 18.9), (3.0, 19.1), (7.0, 18.6), (10.0, 13.5), (13.0, 11.5), (17.0, 9.5), (21.0, 4.5), (24.0, -1.0),
    (27.0, 6.0), (31.0, 12.0), (80.0, 12.0),
])  # fmt: skip
_LINES = {"fold": 0.30, "forehead_lines": 0.16, "crows_feet": 0.26, "under_eye": 0.16}


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
    q, bump = grid.q, grid.bump
    freckle_noise = _waves(generator, grid, 60, 1.5, 2.3)
    cheeks_and_nose = np.maximum(bump(11.0, -2.0, 7.0, 4.5), bump(0.0, -4.0, 4.0, 4.0))
    lips, is_ear = _lip_mask(np.abs(grid.p), q), _is_ear(grid)
    basis = SkinBasis(
        mottling=np.stack([_waves(generator, grid, 10, 9.0, 24.0) for _ in range(SKIN_FIELDS)]),
        strands=_waves(generator, grid, 40, 1.4, 7.0, along=9.0),
        curls=_waves(generator, grid, 50, 3.5, 7.0),
        freckles=smoothstep(1.1, 1.9, freckle_noise) * cheeks_and_nose,
        grain=_waves(generator, grid, 40, 1.3, 2.6),
        blush=bump(13.0, 1.0, 5.5, 4.5) + 0.55 * bump(0.0, -1.5, 3.2, 2.6),
        under_eye=bump(10.8, -9.9, 4.3, 1.5),
        lines=wrinkles(grid),
        lips=lips,
        beards={kind: _beard_amount(grid, kind) * (1.0 - lips) for kind in BEARDS},
        nostrils=bump(2.4, 3.3, 1.05, 0.6),
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
    strands = 1.0 + 0.09 * basis.strands[..., None] + 0.05 * basis.mottling[0][..., None]
    strand_colour = _rgb(identity.hair) * strands
    if identity.beard == "stubble":
        shade = _rgb(0.35 * identity.hair + 0.40 * identity.skin)
        albedo = _over(albedo, shade, np.clip(0.5 * beard * (1.0 + 0.1 * basis.grain), 0.0, 1.0))
        thickness = np.zeros(grid.shape)
    else:
        rough = np.clip(beard * (1.0 + 0.2 * basis.strands), 0.0, 1.0)
        albedo = _over(albedo, 0.9 * strand_colour, 0.9 * smoothstep(0.1, 0.8, rough))
        length = {"full beard": 1.7, "short beard": 0.6}.get(identity.beard, 0.9)
        thickness = length * smoothstep(0.3, 1.0, rough) * (1.0 + 0.06 * basis.strands)
    brow = _brow_mask(identity, grid, basis)
    albedo = _over(albedo, _rgb(0.85 * identity.hair + 0.04), identity.brow_strength * brow)
    parts[(brow > 0.5) & (grid.p > 0)] = PART["l_brow"]
    parts[(brow > 0.5) & (grid.p < 0)] = PART["r_brow"]
    collar = identity.collar + 0.012 * grid.p**2 - 8.0 * smoothstep(0.5, 2.0, np.abs(grid.theta))
    cloth = smoothstep(-0.4, 0.4, grid.q - collar)
    albedo = _over(albedo, _rgb(identity.cloth), cloth)
    parts[cloth > 0.5] = PART["cloth"]
    thickness = thickness + 1.2 * cloth
    style = HAIR_STYLES[identity.hair_style]
    distance = _hair_distance(grid, style, identity)
    distance = distance + 0.5 * basis.strands + 0.9 * style.curl * basis.curls
    soft = 0.9 if style.fall > 2.0 or style.covers_ears else 2.2
    hair = style.cover * smoothstep(-0.8, soft, distance)
    lift = _hair_thickness(grid, style, identity.hair_volume, distance, basis.reach)
    lift = lift * (1.0 + style.curl * 0.22 * basis.curls) + 0.03 * basis.strands * np.clip(lift, 0.0, 1.5)
    if not style.covers_ears:
        hair, lift = hair * (1.0 - basis.is_ear), lift * (1.0 - basis.is_ear)
    root = 1.0 - 0.25 * smoothstep(0.0, 3.0, 3.0 - np.abs(distance))[..., None]
    albedo = _over(albedo, strand_colour * (1.0 + 0.10 * style.curl * basis.curls[..., None]) * root, hair)
    parts[hair > 0.5] = PART["hair"]
    return Skin(
        np.clip(albedo, 0.0, 1.0).astype(np.float32),
        np.maximum(thickness, lift).astype(np.float32),
        _hair_forward(grid, style, distance).astype(np.float32),
        parts,
    )


def _bare_skin(identity: FaceIdentity, basis: SkinBasis) -> ndarray:
    age, deep = identity.age, max(0.0, identity.age - 0.25)
    mottling = np.tensordot(_rgb(identity.skin_noise), basis.mottling, 1)
    tone = 1.0 + (0.022 + 0.016 * age) * mottling / np.sqrt(SKIN_FIELDS) + (0.010 + 0.012 * age) * basis.grain
    albedo = _rgb(identity.skin) * tone[..., None]
    redness = (0.4 + 0.6 * (1.0 - identity.melanin)) * identity.blush * basis.blush
    lines = sum(_LINES[name] * field for name, field in basis.lines.items())
    for amount, colour in (
        (redness, (0.01, 0.12, 0.11)),
        ((0.08 + 0.14 * age) * basis.under_eye, (0.8, 1.0, 0.85)),
        (0.28 * identity.freckles * basis.freckles, (0.7, 1.0, 1.15)),
        (0.16 * ear_share(identity) * basis.ear, (0.5, 1.0, 1.0)),
        (np.clip(deep * lines, 0.0, 0.5), (0.85, 1.0, 1.0)),
    ):
        albedo *= 1.0 - amount[..., None] * _rgb(colour)
    lips = _rgb(identity.lips) * (1.0 + 0.03 * basis.grain[..., None])
    albedo = _over(albedo, lips, 0.9 * basis.lips)
    return albedo * (1.0 - 0.6 * basis.nostrils[..., None] * _rgb((0.85, 1.0, 1.0)))


def _brow_mask(identity: FaceIdentity, grid: FaceGrid, basis: SkinBasis) -> ndarray:
    """Brows: an arch that is thickest at a third and tapers outwards, with a hairy edge."""
    mask = np.zeros(grid.shape, np.float32)
    rows = slice(*np.searchsorted(grid.q[:, 0], _BROW_ROWS))
    p, q = np.abs(grid.p[rows]), grid.q[rows]
    along = np.clip((p - 4.6) / 13.2, 0.0, 1.0)
    arch = identity.brow_arch * 1.6 * np.sin(np.pi * along**1.25)
    centre = -19.8 + 0.5 * (1.0 - along) - arch + 1.3 * along**3
    third = 0.75 + 0.5 * np.sin(np.pi * np.minimum(along * 1.3 + 0.1, 1.0))
    half = identity.brow_thickness * 1.15 * third * (1.0 - 0.65 * along**1.5)
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
    away = np.abs(grid.theta) - ear_slant(grid)
    return (np.abs(grid.q + 5.5) < 7.6) & (away > -0.14) & (away < 0.2)


def _lip_mask(p: ndarray, q: ndarray) -> ndarray:
    arc = np.clip(1.0 - (p / 9.3) ** 2, 0.0, 1.0)
    top = MOUTH_Q - 2.9 * arc**0.9 + 0.55 * hill(p, 0.0, 1.3)
    bottom = MOUTH_Q + 3.6 * np.clip(1.0 - (p / 8.9) ** 2, 0.0, 1.0) ** 0.7
    return smoothstep(-0.45, 0.45, q - top) * smoothstep(-0.6, 0.6, bottom - q) * smoothstep(0.0, 0.08, arc)


def _hair_distance(grid: FaceGrid, style: HairStyle, identity: FaceIdentity) -> ndarray:
    """How far a point lies inside the hair (> 0) or outside it, in face pixels."""
    if style.cover == 0.0:
        return np.full(grid.shape, -50.0)
    turn, p = np.rad2deg(grid.theta[0]), grid.p[0]
    away = np.abs(turn)
    front = -31.3 + identity.hair_line
    rows = np.array(style.line)
    if style.end is not None:
        rows = np.minimum(rows, style.end - front)
    limit = front + PchipInterpolator(_TURNS_DEG, rows)(away)
    recession, parting, wave = identity.hair_recession, identity.hair_parting, identity.hair_wave
    limit -= 5.5 * recession * hill(away, 30.0, 14.0) + 2.5 * recession * (away < 90)
    falls = 1.0 - hill(turn - 26.0 * parting, 0.0, 12.0 if style.line is CURTAIN else 20.0)
    if style.fall > 2.0 and abs(parting) < 0.35:
        falls = 0.35 + 0.65 * falls
    limit += style.fall * falls * hill(away, 0.0, 52.0, 6)
    uneven = np.sin(0.30 * p + 6.3 * wave[1]) + 0.7 * np.sin(0.72 * p + 6.3 * wave[2])
    limit += (0.15 + 0.55 * wave[0]) * uneven * hill(away, 0.0, 60.0, 6)
    return (limit - grid.q) / np.sqrt(1.0 + np.gradient(limit, p) ** 2)


def _hair_thickness(
    grid: FaceGrid, style: HairStyle, volume: float, distance: ndarray, reach: ndarray
) -> ndarray:
    """How far hair stands off the head, face pixels; ``reach`` (rows, 1) is the bare head's half width, which
    hanging hair makes up for."""
    crown = 1.0 - smoothstep(-42.0, -26.0, grid.q)
    away = smoothstep(np.deg2rad(28.0), np.deg2rad(66.0), np.abs(grid.theta))
    full = crown * style.top + (1.0 - crown) * (style.front * (1.0 - away) + style.side * away)
    full *= volume
    if style.hang > 0.0:
        full = full + away * np.where(grid.q > -8.0, np.maximum(_HANG - reach, 0.0), 0.0)
        full = full + style.hang * smoothstep(-4.0, 40.0, grid.q) * away
    edge = np.where(grid.q > 24.0, 4.0, 1.0 + 1.9 * np.clip(full, 0.3, 4.0))
    return full * smoothstep(-0.5, edge, distance)


def _hair_forward(grid: FaceGrid, style: HairStyle, distance: ndarray) -> ndarray:
    """How far hanging hair comes forward of the neck, face pixels: it falls from the temples."""
    if style.hang == 0.0:
        return np.zeros(grid.shape)
    beside = smoothstep(np.deg2rad(46.0), np.deg2rad(62.0), np.abs(grid.theta))
    return 11.0 * beside * smoothstep(26.0, 36.0, grid.q) * smoothstep(-0.5, 4.0, distance)


def _beard_amount(grid: FaceGrid, kind: str) -> ndarray:
    """Where a beard of this kind grows, 0..1; leaves the lips to the caller."""
    p, q = np.abs(grid.p), grid.q
    line = PchipInterpolator(*_BEARD_LINE.T)(p)
    soft = 5.0 if kind == "stubble" else 2.0
    cheeks = smoothstep(-soft, 1.6 * soft, q - line) * (1.0 - smoothstep(32.0, 37.0, q))
    moustache = np.exp(-(((q - 9.6 - 0.030 * p**2) / 2.0) ** 4))
    moustache = moustache * hill(p, 0.0, 10.5, 6) * (1.0 - 0.45 * hill(p, 0.0, 1.2))
    chin = smoothstep(-1.0, 1.5, q - np.maximum(line, 10.0)) * hill(p, 0.0, 9.5, 6)
    chin = chin * (1.0 - smoothstep(31.0, 35.0, q))
    grown = {"none": np.zeros(grid.shape), "moustache": moustache, "goatee": np.maximum(chin, moustache)}
    return grown.get(kind, np.maximum(cheeks, moustache))


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
