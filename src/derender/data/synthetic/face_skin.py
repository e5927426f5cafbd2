"""The built-in faces: the colour of a face (albedo free of shading), its parts, the hair that grows on it.

Hair is part of the head's surface: it grows above a line around the head, given as a row ``q`` for each
angle, and lifts the surface by its thickness. Eyes and the inside of the mouth change from image to image and
are painted over it: lids follow the expression, irises the gaze; the mouth's inside shows as far as the lips
have parted. Leaves out highlights, single strands, plaits, and hair that hangs free of the head.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data import MASK_CLASSES
from derender.data.synthetic import face_shape as head
from derender.data.synthetic.face_identity import SKIN_FIELDS, Identity, draw_identity, identity_columns
from derender.data.synthetic.face_shape import FaceGrid, FaceShape, gauss, hill, smoothstep
from derender.data.synthetic.mesh_image import TriangleMesh, grid_triangles
from derender.data.synthetic.morphable import NOSE_TIP_Z, MeshOf
from derender.data.synthetic.settings import FaceSettings, numbers_of
from derender.data.synthetic.synthetic_set import Row

Albedo = Float32[ndarray, "3 rows columns"]  # 0..1
Parts = Int32[ndarray, "rows columns"]  # numbers into MASK_CLASSES
PART = {name: number for number, name in enumerate(MASK_CLASSES)}
_FIELD_SEED = 7  # the noise fields are part of the model, the same for everyone; identities mix them
_HANG = 27.5  # half width at which hair falls past jaw and neck
_LASH, _SCLERA, _PINK, _PUPIL, _TOOTH, _DARK, _TONGUE = np.array([
    (0.10, 0.07, 0.06), (0.86, 0.83, 0.81), (0.74, 0.45, 0.42), (0.02, 0.02, 0.02), (0.87, 0.83, 0.76),
    (0.15, 0.05, 0.05), (0.60, 0.26, 0.25),
], np.float32)[..., None, None]  # fmt: skip
_IRIS_RADIUS, _PUPIL_RADIUS = 2.4, 1.0
_FACE_PX = float(np.tan(np.deg2rad(5.0)) / 31.5)  # scene units per face pixel at z = 1
_DOWN_PX = 2.6  # the face sits this much below the middle, so that hair shows


class HairStyle(NamedTuple):
    """A row of ``hair_styles`` in ``faces.yaml``, face pixels."""

    line: str
    top: float  # thickness on the crown
    front: float  # over the forehead's edge
    side: float  # over the ears
    hang: float  # below them
    curl: float  # unevenness
    cover: float  # opacity
    fall: float  # how far a fringe falls
    end: float  # row at which hanging hair ends

    @property
    def covers_ears(self) -> bool:
        return self.side > 1.5


class Skin(NamedTuple):
    """One person's surface."""

    albedo: Albedo
    thickness: Float32[ndarray, "rows columns"]  # of hair and clothes, face pixels
    forward: Float32[ndarray, "rows columns"]  # how far hair hangs forward, face pixels
    parts: Parts


@lru_cache(maxsize=4)
def skin_fields(detail: float = 1.0) -> dict[str, ndarray]:
    """Fixed fields over the domain, between 0 and 1 or zero-mean, and the parts that never move."""
    grid, generator = head.face_shape(detail).grid, np.random.default_rng(_FIELD_SEED)
    p, q, bump = np.abs(grid.p), grid.q, grid.bump
    freckles = _waves(generator, grid, 60, 1.5, 2.3)
    cheeks_and_nose = np.maximum(bump(11.0, -2.0, 7.0, 4.5), bump(0.0, -4.0, 4.0, 4.0))
    arc = np.clip(1.0 - (p / 9.3) ** 2, 0.0, 1.0)
    upper = head.MOUTH_Q - 2.9 * arc**0.9 + 0.55 * hill(p, 0.0, 1.3)
    lower = head.MOUTH_Q + 3.6 * np.clip(1.0 - (p / 8.9) ** 2, 0.0, 1.0) ** 0.7
    lips = smoothstep(-0.45, 0.45, q - upper) * smoothstep(-0.6, 0.6, lower - q) * smoothstep(0.0, 0.08, arc)
    away = head.ear_angle(grid)
    is_ear = (np.abs(q + 5.5) < 7.6) & (away > -0.14) & (away < 0.2)  # where an ear folds out of the head
    depths = ("fold", 0.30, 0.30), ("forehead_lines", 0.16, 0.12), ("crows_feet", 0.26, 0.16)
    named = head.named_fields(grid)
    lines = sum(share * np.clip(named[name] / top, 0.0, 1.0) for name, share, top in depths)
    parts = np.full(p.shape, PART["skin"], np.int32)
    width = np.interp(q, [-13.0, -6.0, -2.5, 0.0, 2.5, 4.0], [2.2, 3.4, 5.2, 6.4, 5.8, 3.0])
    for name, where in {  # left and right being the person's own
        "nose": (q > -13.0) & (q < 4.0) & (p < width),
        "l_ear": is_ear & (grid.p > 0),
        "r_ear": is_ear & (grid.p < 0),
        "neck": (q > 32.0) & ~is_ear,
        "u_lip": (lips > 0.5) & (q <= head.MOUTH_Q),
        "l_lip": (lips > 0.5) & (q > head.MOUTH_Q),
    }.items():
        parts[where] = PART[name]
    fields = {
        "mottling": np.stack([_waves(generator, grid, 10, 9.0, 24.0) for _ in range(SKIN_FIELDS)]),
        "strands": _waves(generator, grid, 40, 1.4, 7.0, along=9.0),
        "curls": _waves(generator, grid, 50, 3.5, 7.0),
        "freckles": smoothstep(1.1, 1.9, freckles) * cheeks_and_nose,
        "grain": _waves(generator, grid, 40, 1.3, 2.6),
        "blush": bump(13.0, 1.0, 5.5, 4.5) + 0.55 * bump(0.0, -1.5, 3.2, 2.6),
        "under_eye": bump(10.8, -9.9, 4.3, 1.5),
        "lines": lines + 0.16 * bump(10.5, -9.2, 4.0, 0.8),
        "lips": lips,
        "nostrils": bump(2.4, 3.3, 1.05, 0.6),
        "ear": gauss(np.abs(grid.theta), 1.44, 0.06) * gauss(q, -3.0, 4.0),
        **{kind: where * (1.0 - lips) for kind, where in _beards(p, q).items()},
    }
    single = {name: field.astype(np.float32) for name, field in fields.items()}
    return single | {"parts": parts, "is_ear": is_ear}


def _beards(p: ndarray, q: ndarray) -> dict[str, ndarray]:
    """Where beards grow, 0..1."""
    line = PchipInterpolator(*np.transpose(numbers_of("faces")["beard_line"]))(p)
    moustache = np.exp(-(((q - 9.6 - 0.030 * p**2) / 2.0) ** 4))
    moustache = moustache * hill(p, 0.0, 10.5, 6) * (1.0 - 0.45 * hill(p, 0.0, 1.2))
    chin = smoothstep(-1.0, 1.5, q - np.maximum(line, 10.0)) * hill(p, 0.0, 9.5, 6)
    chin = chin * (1.0 - smoothstep(31.0, 35.0, q))
    stubble, short = (
        np.maximum(smoothstep(-soft, 1.6 * soft, q - line) * (1.0 - smoothstep(32.0, 37.0, q)), moustache)
        for soft in (5.0, 2.0)
    )
    full = {"stubble": stubble, "short beard": short, "full beard": short}
    return full | {"moustache": moustache, "goatee": np.maximum(chin, moustache)}


def _waves(
    generator: np.random.Generator, grid: FaceGrid, count: int, shortest: float, longest: float,
    along: float | None = None,
) -> ndarray:  # fmt: skip
    """A smooth zero-mean field of unit variance: ``count`` plane waves of such wavelengths (face pixels).
    With ``along`` they run sideways only, mirrored, and bend slowly over that length, like strands."""
    total = np.zeros(grid.p.shape)
    for _ in range(count):
        number = 2.0 * np.pi / generator.uniform(shortest, longest)
        phase, angle = generator.uniform(0, 2 * np.pi, 2)
        if along is None:
            total += np.cos(number * (np.cos(angle) * grid.p + np.sin(angle) * grid.q) + phase)
        else:
            bend = generator.uniform(0.3, 0.9) * np.sin(grid.q / along + angle)
            total += np.cos(number * (np.abs(grid.p) + bend) + phase)
    return total * np.sqrt(2.0 / count)


def paint_skin(who: Identity, style: HairStyle, shape: FaceShape, fields: dict[str, ndarray]) -> Skin:
    """One person's skin, brows, beard, clothes and hair."""
    grid, parts = shape.grid, fields["parts"].copy()
    albedo, thickness = _bare_skin(who, fields, style), np.zeros(grid.p.shape, np.float32)
    strands = 1.0 + 0.09 * fields["strands"] + 0.05 * fields["mottling"][0]
    strand_colour = _rgb(who["hair"]) * strands
    if who["beard"] == "stubble":
        shade = _rgb(0.35 * who["hair"] + 0.40 * who["skin"])
        _over(albedo, shade, 0.5 * fields["stubble"] * (1.0 + 0.1 * fields["grain"]))
    elif who["beard"] != "none":
        rough = fields[who["beard"]] * (1.0 + 0.2 * fields["strands"])
        _over(albedo, 0.9 * strand_colour, 0.9 * smoothstep(0.1, 0.8, rough))
        length = {"full beard": 1.7, "short beard": 0.6}.get(who["beard"], 0.9)
        thickness = length * smoothstep(0.3, 1.0, rough) * (1.0 + 0.06 * fields["strands"])
    brow = _brows(who, grid, fields["grain"])
    _over(albedo, _rgb(0.85 * who["hair"] + 0.04), who["brow_strength"] * brow)
    parts[(brow > 0.5) & (grid.p > 0)] = PART["l_brow"]
    parts[(brow > 0.5) & (grid.p < 0)] = PART["r_brow"]
    collar = who["collar"] + 0.012 * grid.p**2 - 8.0 * smoothstep(0.5, 2.0, np.abs(grid.theta))
    cloth = smoothstep(-0.4, 0.4, grid.q - collar)
    _over(albedo, _rgb(who["cloth"]), cloth)
    parts[cloth > 0.5] = PART["cloth"]
    distance = _hair_distance(grid, style, who) + 0.5 * fields["strands"] + 0.9 * style.curl * fields["curls"]
    hair = style.cover * smoothstep(-0.8, 0.9 if style.fall > 2.0 or style.covers_ears else 2.2, distance)
    lift, forward = _hair_thickness(shape, style, who["hair_volume"], distance)
    uneven = 0.03 * fields["strands"] * np.clip(lift, 0.0, 1.5)
    lift = lift * (1.0 + style.curl * 0.22 * fields["curls"]) + uneven
    if not style.covers_ears:
        hair, lift = hair * (1.0 - fields["is_ear"]), lift * (1.0 - fields["is_ear"])
    root = 1.0 - 0.25 * smoothstep(0.0, 3.0, 3.0 - np.abs(distance))
    _over(albedo, strand_colour * _single((1.0 + 0.10 * style.curl * fields["curls"]) * root), hair)
    parts[hair > 0.5] = PART["hair"]
    thickness = _single(np.maximum(thickness + 1.2 * cloth, lift))
    return Skin(np.clip(albedo, 0.0, 1.0), thickness, _single(forward), parts)


def _bare_skin(who: Identity, fields: dict[str, ndarray], style: HairStyle) -> Albedo:
    age, grain = who["age"], fields["grain"]
    mottling = np.tensordot(_single(who["skin_noise"] / np.sqrt(SKIN_FIELDS)), fields["mottling"], 1)
    tone = 1.0 + (0.022 + 0.016 * age) * mottling + (0.010 + 0.012 * age) * grain
    albedo = _rgb(who["skin"]) * _single(tone)
    for amount, field, colour in (
        ((0.4 + 0.6 * (1.0 - who["melanin"])) * who["blush"], "blush", (0.01, 0.12, 0.11)),
        (0.08 + 0.14 * age, "under_eye", (0.8, 1.0, 0.85)),
        (0.28 * who["freckles"], "freckles", (0.7, 1.0, 1.15)),
        (0.16 * who["ear_size"] * (not style.covers_ears), "ear", (0.5, 1.0, 1.0)),
        (max(0.0, age - 0.25), "lines", (0.85, 1.0, 1.0)),
    ):
        amount = np.minimum(_single(amount) * fields[field], 0.5 if field == "lines" else np.inf)
        albedo *= 1.0 - amount * _rgb(colour)
    _over(albedo, _rgb(who["lips"]) * (1.0 + 0.03 * grain), 0.9 * fields["lips"])
    return albedo * (1.0 - 0.6 * fields["nostrils"] * _rgb((0.85, 1.0, 1.0)))


def _brows(who: Identity, grid: FaceGrid, grain: ndarray) -> Float32[ndarray, "rows columns"]:
    """Brows: an arch that is thickest at a third and tapers outwards, with a hairy edge."""
    p = np.abs(grid.p)
    along = np.clip((p - 4.6) / 13.2, 0.0, 1.0)
    arch = who["brow_arch"] * 1.6 * np.sin(np.pi * along**1.25)
    centre = -19.8 + 0.5 * (1.0 - along) - arch + 1.3 * along**3
    third = 0.75 + 0.5 * np.sin(np.pi * np.minimum(along * 1.3 + 0.1, 1.0))
    half = who["brow_thickness"] * 1.15 * third * (1.0 - 0.65 * along**1.5)
    edge = (half - np.abs(grid.q - centre)) / 0.7 + 0.12 * grain
    ends = smoothstep(3.9, 6.2, p) * (1.0 - smoothstep(15.8, 18.6, p))
    return _single(smoothstep(-0.6, 0.8, edge) * ends)


def _hair_distance(grid: FaceGrid, style: HairStyle, who: Identity) -> Float[ndarray, "rows columns"]:
    """How far a point lies inside the hair (> 0) or outside it, in face pixels."""
    numbers, turn, p = numbers_of("faces"), np.rad2deg(grid.theta[0]), grid.p[0]
    away, front, parting = np.abs(turn), -31.3 + who["hair_line"], who["hair_parting"]
    rows = np.minimum(numbers["hair_lines"][style.line], style.end - front)
    limit = front + PchipInterpolator(numbers["turns"], rows)(away)
    limit -= who["hair_recession"] * (5.5 * hill(away, 30.0, 14.0) + 2.5 * (away < 90))
    falls = 1.0 - hill(turn - 26.0 * parting, 0.0, 12.0 if style.line == "curtain" else 20.0)
    if style.fall > 2.0 and abs(parting) < 0.35:
        falls = 0.35 + 0.65 * falls
    limit += style.fall * falls * hill(away, 0.0, 52.0, 6)
    size, *phases = who["hair_wave"][:3]
    uneven = np.sin(0.30 * p + 6.3 * phases[0]) + 0.7 * np.sin(0.72 * p + 6.3 * phases[1])
    limit += (0.15 + 0.55 * size) * uneven * hill(away, 0.0, 60.0, 6)
    return (limit - grid.q) / np.sqrt(1.0 + np.gradient(limit, p) ** 2)


def _hair_thickness(shape: FaceShape, style: HairStyle, volume: float, distance: ndarray) -> Any:
    """How far hair stands off the head, and hanging hair comes forward of the neck, in face pixels."""
    theta, q = np.abs(shape.grid.theta), shape.grid.q
    crown = 1.0 - smoothstep(-42.0, -26.0, q)
    away = smoothstep(np.deg2rad(28.0), np.deg2rad(66.0), theta)
    full = volume * (crown * style.top + (1.0 - crown) * (style.front * (1.0 - away) + style.side * away))
    forward = np.zeros(q.shape)
    if style.hang > 0.0:
        full = full + away * np.where(q > -8.0, np.maximum(_HANG - shape.reach, 0.0), 0.0)
        full = full + style.hang * smoothstep(-4.0, 40.0, q) * away
        beside = smoothstep(np.deg2rad(46.0), np.deg2rad(62.0), theta)
        forward = 11.0 * beside * smoothstep(26.0, 36.0, q) * smoothstep(-0.5, 4.0, distance)
    edge = np.where(q > 24.0, 4.0, 1.0 + 1.9 * np.clip(full, 0.3, 4.0))
    return full * smoothstep(-0.5, edge, distance), forward


def paint_eyes(
    albedo: Albedo, parts: Parts, grid: FaceGrid, who: Identity, lids: Float32[ndarray, "2 2"], gaze: ndarray
) -> None:
    """Paint one person's eyes in place. lids: how wide and how squinted the eye at p < 0 and that at p > 0
    are; gaze: face pixels."""
    rows, columns = np.abs(grid.q[:, 0] - head.EYE_Q) < 7.0, np.abs(np.abs(grid.p[0]) - head.EYE_P) < 8.0
    at = np.ix_(rows, columns)
    colour, p, y = albedo[:, *at], _single(grid.p[:1, columns]), _single(grid.q[rows, :1] - head.EYE_Q)
    (wide, squint), (right, down) = lids[:, (p[0] > 0).astype(int)], gaze
    up = 2.35 * np.clip(who["eye_opening"] * (1.0 + 0.34 * wide - 0.42 * squint), 0.25, 1.7)
    low = 1.4 * np.clip(who["eye_opening"] * (1.0 + 0.2 * wide - 0.45 * squint), 0.2, 1.5)
    outward, length, lashes = np.abs(p) - head.EYE_P, who["eye_length"], who["lashes"]
    level, along = y + who["eye_tilt"] * outward, outward / length
    body = np.maximum(1.0 - along**2, 0.0)
    below_upper = level + up * body**0.75 * (1.0 - 0.12 * along)  # > 0 below the upper lid's edge
    above_lower = low * body**0.9 * (1.0 + 0.15 * along) - level
    fold = who["lid_crease"] * gauss(below_upper, -1.5, 0.42) * hill(along, 0.0, 1.05, 4)
    lid = gauss(below_upper, -0.9, 0.9) * hill(along, 0.0, 1.1, 4)
    colour *= (1.0 - 0.28 * fold) * (1.0 - 0.10 * lid)
    inside = np.where(body > 0.0, np.minimum(below_upper, above_lower) / 0.45 + 0.5, 0.0)
    distance = np.hypot(p - np.sign(p) * head.EYE_P - right, level - down + 0.55)
    shade = (1.0 - 0.28 * np.exp(-np.maximum(below_upper, 0.0) / 0.7)) * (1.0 - 0.12 * np.abs(along))
    rim = 1.15 - 0.75 * np.clip((distance - _IRIS_RADIUS + 0.7) / 0.55, 0.0, 1.0)
    ball, iris = shade * _SCLERA, rim * _rgb(who["iris"])
    _over(ball, _PINK, 1.6 * (-along - 0.62))
    _over(iris, _PUPIL, (_PUPIL_RADIUS - distance) / 0.35 + 0.5)
    _over(ball, iris, (_IRIS_RADIUS - distance) / 0.4 + 0.5)
    _over(colour, ball, inside)
    lash = hill(below_upper, -0.15, 0.40 + 0.20 * lashes * (1.0 + 0.6 * along)) * hill(along, 0.0, 1.02, 8)
    _over(colour, _LASH, 0.95 * lashes * lash)
    _over(colour, _LASH, 0.28 * lashes * hill(above_lower, -0.1, 0.4) * hill(along, 0.0, 0.95, 8))
    albedo[:, *at] = colour
    side = np.where(p > 0, PART["l_eye"], PART["r_eye"])
    parts[at] = np.where(inside > 0.5, side, parts[at])


def paint_mouth(
    albedo: Albedo, parts: Parts, grid: FaceGrid, who: Identity, gap: Float32[ndarray, "columns"]
) -> None:
    """Paint one person's open mouth in place; ``gap`` is by how much the lips have parted, face pixels."""
    rows, columns = np.abs(grid.q[:, 0] - head.MOUTH_Q) < 1.1 * head.MOUTH_BAND, np.abs(grid.p[0]) < 9.3
    at = np.ix_(rows, columns)
    colour, p, gap = albedo[:, *at], _single(grid.p[:1, columns]), gap[columns]
    across = _single((grid.q[rows, :1] - head.MOUTH_Q) / head.MOUTH_BAND)  # -1, 1: the lips' edges
    lens = np.sqrt(1.0 - (p / 9.3) ** 2)
    below = 0.5 * (across + 1.0) * gap
    groove = 1.0 - 0.12 * hill(p - 1.9 * np.round(p / 1.9), 0.0, 0.25)
    tongue = (2.2 * lens - (gap - below)) * np.clip((gap - 4.0) / 2.0, 0.0, 1.0)
    shown = (1.0 - 0.5 * (p / 8.0) ** 2) * np.clip((gap - 0.9) / 0.9, 0.0, 1.0)
    parted = np.clip((gap - 0.8) / 0.7, 0.0, 1.0)
    cover = (1.08 - np.abs(across)) / 0.25 * np.minimum(lens * 2.5, 1.0) * (0.85 + 0.15 * parted)
    inside, line = np.empty_like(colour), np.empty_like(colour)
    inside[:], line[:] = _DARK, _rgb(0.38 * who["lips"])
    _over(inside, _TONGUE, tongue)
    _over(inside, groove * _TOOTH, np.minimum((2.7 - below) / 0.4 + 0.5, 1.0) * shown)
    _over(line, inside, parted)
    _over(colour, line, cover)
    albedo[:, *at] = colour
    parts[at] = np.where((cover > 0.5) & (parted > 0.5), PART["mouth"], parts[at])


def built_in_person(
    shape: FaceShape, fields: dict[str, ndarray], seed: int, identity: int, settings: FaceSettings
) -> tuple[MeshOf, Row, Row]:
    """One identity: its mesh by expression, its labels, and its traits for tables."""
    generator = np.random.default_rng([seed, 2, identity])
    who = draw_identity(generator, shape.names, settings.age_years, settings.skin_tone)
    style = HairStyle(*numbers_of("faces")["hair_styles"][who["hair_style"]])
    skin, scale = paint_skin(who, style, shape, fields), np.float32(who["scale"])
    neutral = shape.mean.copy()  # face pixels
    for weight, mode in zip(who["shape"].values(), shape.modes, strict=True):
        neutral += np.float32(weight) * mode
    if not style.covers_ears:
        neutral += np.float32(who["ear_size"]) * shape.ear
    nose_tip = float(neutral[..., 2].min()) * who["scale"]
    neutral += skin.thickness[..., None] * shape.outward
    neutral[..., 2] -= skin.forward
    neutral *= scale
    labels: Row = {"age": round(who["age_years"], 1), "skin_tone": round(who["melanin"], 4)}
    labels |= {"build": round(who["build"], 4), "hair": who["hair_style"]}
    labels |= {"hair_colour": who["hair_colour"], "beard": who["beard"]}

    def mesh(expression: head.Expression) -> TriangleMesh:
        grid, sides = shape.grid, expression.sides
        surface, albedo, parts = neutral.copy(), skin.albedo.copy(), skin.parts.copy()
        for a, side in np.argwhere(sides[: len(head.ACTIONS)]):
            surface += sides[a, side] * scale * shape.actions[2 * a + side]
        edges = head.MOUTH_Q + head.MOUTH_BAND * np.array([-1.0, 1.0])
        top, bottom = np.searchsorted(grid.q[:, 0], edges)
        paint_mouth(albedo, parts, grid, who, (surface[bottom, :, 1] - surface[top - 1, :, 1]) / scale)
        paint_eyes(albedo, parts, grid, who, sides[len(head.ACTIONS) :], expression.gaze)
        surface += np.array([0.0, _DOWN_PX, -nose_tip], np.float32)
        surface *= np.float32(_FACE_PX)  # scene units
        surface[..., 2] += np.float32(NOSE_TIP_Z)
        surface[..., 2] -= 1.0
        colours = np.ascontiguousarray(albedo.reshape(3, -1).T)
        triangles = grid_triangles(*parts.shape)
        return TriangleMesh(surface.reshape(-1, 3), triangles, colours, parts.ravel())

    return mesh, labels, identity_columns(who)


def _single(values: Any) -> ndarray:
    return np.asarray(values, np.float32)


def _rgb(values: Any) -> Float32[ndarray, "3 1 1"]:
    return _single(values)[:, None, None]


def _over(under: Float32[ndarray, "3 rows columns"], colour: ndarray, alpha: ndarray) -> None:
    """Lay a colour over another, in place; the opacity is cut to 0..1."""
    under += (colour - under) * _single(np.minimum(np.maximum(alpha, 0.0), 1.0))
