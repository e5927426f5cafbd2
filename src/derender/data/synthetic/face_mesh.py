"""The built-in face model: an identity's surface and skin, and one mesh per image with expression and eyes.

The mesh is the grid of ``face_shape``; a user's own morphable model (``morphable``) has the same methods.
Eyes and the inside of the mouth are painted over the skin's albedo: lids follow the expression, irises the
gaze; the mouth's inside shows teeth, dark and tongue as far as the lips have parted. Colours only: no
highlights, since albedo holds no light.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from numpy import ndarray

from derender.data.synthetic.face_draw import NOSE_TIP_Z, FaceDraw
from derender.data.synthetic.face_identity import FaceIdentity, draw_identity
from derender.data.synthetic.face_shape import (
    EYE_P,
    EYE_Q,
    MOUTH_BAND,
    MOUTH_Q,
    bare_head,
    face_basis,
    face_grid,
    grid_triangles,
    smoothstep,
)
from derender.data.synthetic.face_skin import PART, Skin, ear_share, paint_skin
from derender.data.synthetic.settings import FaceSettings
from derender.render.numba_threads import kernel

FACE_PX = float(np.tan(np.deg2rad(5.0)) / 31.5)  # scene units per face pixel at z = 1
_DOWN_PX = 2.6  # the face sits this much below the middle, so that hair shows
_LASH = (0.10, 0.07, 0.06)
_SCLERA = (0.86, 0.83, 0.81)
_PINK = (0.74, 0.45, 0.42)
_PUPIL = (0.02, 0.02, 0.02)
_TOOTH = (0.87, 0.83, 0.76)
_DARK = (0.15, 0.05, 0.05)
_TONGUE = (0.60, 0.26, 0.25)
_LEFT_EYE, _RIGHT_EYE, _MOUTH = PART["l_eye"], PART["r_eye"], PART["mouth"]
_IRIS_RADIUS, _PUPIL_RADIUS = 2.4, 1.0


@dataclass(frozen=True)
class Person:
    """One identity's neutral surface (face pixels) and skin."""

    who: FaceIdentity
    surface: Float32[ndarray, "rows columns 3"]
    skin: Skin
    nose_tip: float


@dataclass(frozen=True)
class ProceduralFaces:
    """The built-in model at the grid detail that suits an image size."""

    detail: float

    @property
    def triangles(self) -> Int32[ndarray, "f 3"]:
        return grid_triangles(*face_grid(self.detail).shape)

    def prepare(self) -> None:
        """Compute what all images share, before threads ask for it."""
        _outward(self.detail)
        face_basis(self.detail)

    def person(self, seed: int, identity: int, settings: FaceSettings) -> Person:
        """One identity; a function of seed, number and the settings' ranges of age and skin tone."""
        basis = face_basis(self.detail)
        generator = np.random.default_rng([seed, 2, identity])
        who = draw_identity(generator, basis.names, settings.age_years, settings.skin_tone)
        surface = basis.mean.copy()
        for name, mode in zip(basis.names, basis.modes, strict=True):
            surface += np.float32(who.shape[name]) * mode
        skin = paint_skin(who, self.detail)
        surface += np.float32(ear_share(who)) * basis.ear
        tip = float(surface[..., 2].min()) * who.scale
        surface += skin.thickness[..., None] * _outward(self.detail)
        surface[..., 2] -= skin.forward
        surface *= np.float32(who.scale)
        return Person(who, surface, skin, tip)

    def traits(self, person: Person) -> dict[str, float | str]:
        return person.who.vector()

    def labels(self, person: Person) -> dict[str, float | str]:
        """The identity's columns of params.csv."""
        who = person.who
        return {
            "age": round(who.age_years, 1),
            "skin_tone": round(who.melanin, 4),
            "build": round(who.build, 4),
            "hair": who.hair_style,
            "hair_colour": who.hair_colour,
            "beard": who.beard,
        }

    def meshes(
        self, draws: list[FaceDraw], people: dict[int, Person]
    ) -> tuple[Float32[ndarray, "n v 3"], Float32[ndarray, "n v 3"], UInt8[ndarray, "n v"]]:
        """Canonical vertices in scene units, their albedo and their part, one mesh per draw."""
        grid, basis = face_grid(self.detail), face_basis(self.detail)
        shown = [people[d.identity] for d in draws]
        q = grid.q[:, 0]
        top, bottom = np.searchsorted(q, [MOUTH_Q - MOUTH_BAND, MOUTH_Q + MOUTH_BAND])
        vertices = np.stack([p.surface for p in shown])
        gap = np.empty((len(draws), grid.shape[1]), np.float32)
        _assemble(
            np.stack([d.actions for d in draws]), basis.actions, basis.boxes,
            np.array([p.who.scale for p in shown], np.float32),
            np.array([p.nose_tip for p in shown], np.float32), vertices, top - 1, bottom, gap,
        )  # fmt: skip
        albedo, parts = np.stack([p.skin.albedo for p in shown]), np.stack([p.skin.parts for p in shown])
        _paint_features(
            albedo, parts, grid.p[0], q, gap,
            np.array([_lids(p.who, d.lids) for p, d in zip(shown, draws, strict=True)]),
            np.stack([p.who.iris for p in shown]), np.stack([p.who.lips for p in shown]),
            np.stack([d.gaze for d in draws]),
        )  # fmt: skip
        count = len(draws)
        return vertices.reshape(count, -1, 3), albedo.reshape(count, -1, 3), parts.reshape(count, -1)


@lru_cache(maxsize=4)
def _outward(detail: float) -> Float32[ndarray, "rows columns 3"]:
    """Unit vectors out of the bare head: its normals, level below the ears, where hair hangs."""
    grid = face_grid(detail)
    head = bare_head(grid)
    normal = _unit(np.cross(np.gradient(head, axis=0), np.gradient(head, axis=1)))
    level = np.stack([np.sin(grid.theta), np.zeros(grid.shape), -np.cos(grid.theta)], axis=-1)
    low = smoothstep(2.0, 20.0, grid.q)[..., None]
    return _unit((1.0 - low) * normal + low * level).astype(np.float32)


def _unit(vectors: ndarray) -> ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


@kernel
@no_type_check
def _assemble(actions, fields, boxes, scale, tip, vertices, top, bottom, gap):
    """Add expressions to neutral surfaces, move to scene units, and measure how far the lips have parted."""
    for n in range(len(vertices)):
        for a in range(actions.shape[1]):
            for side in range(2):
                weight = actions[n, a, side] * scale[n]
                if weight == 0.0:
                    continue
                first, last, left, right = boxes[a, side]
                for r in range(first, last):
                    for c in range(left, right):
                        for k in range(3):
                            vertices[n, r, c, k] += weight * fields[a, side, r, c, k]
        for c in range(vertices.shape[2]):
            gap[n, c] = (vertices[n, bottom, c, 1] - vertices[n, top, c, 1]) / scale[n]
        unit, nose = np.float32(FACE_PX), np.float32(NOSE_TIP_Z)
        for r in range(vertices.shape[1]):
            for c in range(vertices.shape[2]):
                vertices[n, r, c, 0] *= unit
                vertices[n, r, c, 1] = unit * (vertices[n, r, c, 1] + np.float32(_DOWN_PX))
                vertices[n, r, c, 2] = nose + unit * (vertices[n, r, c, 2] - tip[n])


def _lids(who: FaceIdentity, lids: Float32[ndarray, "2 2"]) -> Float64[ndarray, "8"]:
    """The row of ``eyes`` in _paint_features."""
    wide, squint = lids
    up = 2.35 * np.clip(who.eye_opening * (1.0 + 0.34 * wide - 0.42 * squint), 0.25, 1.7)
    low = 1.4 * np.clip(who.eye_opening * (1.0 + 0.2 * wide - 0.45 * squint), 0.2, 1.5)
    tail = (who.eye_tilt, who.lashes, who.lid_crease)
    return np.array([who.eye_length, up[0], low[0], up[1], low[1], *tail], np.float64)


@kernel
@no_type_check
def _paint_features(albedo, parts, p, q, gap, eyes, iris, lips, gaze):
    """Paint in place, one face per row.

    albedo (N,R,C,3); parts (N,R,C) uint8, set where eyes and the mouth's inside show; p (C,) and q (R,)
    domain coordinates; gap (N,C) by how much the lips have parted, face pixels; eyes (N,8): half length,
    upper and lower opening of the eye at p < 0, then of the eye at p > 0, tilt, lashes, crease; iris, lips
    (N,3); gaze (N,2), face pixels.
    """
    for n in range(albedo.shape[0]):
        for r in range(len(q)):
            near_eye = abs(q[r] - EYE_Q) < 7.0
            in_mouth = abs(q[r] - MOUTH_Q) < 1.1 * MOUTH_BAND
            if not (near_eye or in_mouth):
                continue
            for c in range(len(p)):
                beside = near_eye and abs(abs(p[c]) - EYE_P) < 8.0
                part = parts[n, r, c : c + 1]
                if beside:
                    _paint_eye(albedo[n, r, c], part, p[c], q[r] - EYE_Q, eyes[n], iris[n], gaze[n])
                if in_mouth and abs(p[c]) < 9.3:
                    across = (q[r] - MOUTH_Q) / MOUTH_BAND
                    _paint_mouth(albedo[n, r, c], part, p[c], across, gap[n, c], lips[n])


@kernel
@no_type_check
def _paint_eye(colour, part, p, y, eye, iris, gaze):
    side = 1.0 if p > 0.0 else -1.0
    up, low = (eye[3], eye[4]) if side > 0 else (eye[1], eye[2])
    length, tilt, lashes, crease = eye[0], eye[5], eye[6], eye[7]
    outward = side * p - EYE_P
    level = y + tilt * outward
    along = outward / length
    body = max(1.0 - along * along, 0.0)
    below_upper = level + up * body**0.75 * (1.0 - 0.12 * along)  # > 0 below the upper lid's edge
    above_lower = low * body**0.9 * (1.0 + 0.15 * along) - level
    fold = np.exp(-0.5 * ((below_upper + 1.5) / 0.42) ** 2) * np.exp(-((outward / (1.05 * length)) ** 4))
    lid = np.exp(-0.5 * ((below_upper + 0.9) / 0.9) ** 2) * np.exp(-((outward / (1.1 * length)) ** 4))
    for k in range(3):
        colour[k] *= (1.0 - 0.28 * crease * fold) * (1.0 - 0.10 * lid)
    inside = 0.0
    if body > 0.0:
        inside = min(below_upper, above_lower) / 0.45 + 0.5
        if inside > 0.0:
            x, v = p - side * EYE_P - gaze[0], level - gaze[1] + 0.55
            _paint_eyeball(colour, inside, np.sqrt(x * x + v * v), below_upper, along, iris)
    thick = 0.40 + 0.20 * lashes * (1.0 + 0.6 * along)
    lash = np.exp(-(((below_upper + 0.15) / thick) ** 2)) * np.exp(-((outward / (1.02 * length)) ** 8))
    rim = np.exp(-(((above_lower + 0.1) / 0.4) ** 2)) * np.exp(-((outward / (0.95 * length)) ** 8))
    for k in range(3):
        colour[k] = _mixed(colour[k], _LASH[k], 0.95 * lashes * lash)
        colour[k] = _mixed(colour[k], _LASH[k], 0.28 * lashes * rim)
    if inside > 0.5:
        part[0] = _LEFT_EYE if p > 0.0 else _RIGHT_EYE


@kernel
@no_type_check
def _paint_eyeball(colour, inside, distance, below_upper, along, iris):
    shade = (1.0 - 0.28 * np.exp(-max(below_upper, 0.0) / 0.7)) * (1.0 - 0.12 * abs(along))
    rim = 1.15 - 0.75 * min(max((distance - _IRIS_RADIUS + 0.7) / 0.55, 0.0), 1.0)
    for k in range(3):
        value = _mixed(_SCLERA[k] * shade, _PINK[k], 1.6 * (-along - 0.62))
        ring = _mixed(iris[k] * rim, _PUPIL[k], (_PUPIL_RADIUS - distance) / 0.35 + 0.5)
        value = _mixed(value, ring, (_IRIS_RADIUS - distance) / 0.4 + 0.5)
        colour[k] = _mixed(colour[k], value, inside)


@kernel
@no_type_check
def _paint_mouth(colour, part, p, across, gap, lips):
    """``across`` runs from -1 (upper lip's edge) to 1 (lower lip's edge)."""
    lens = np.sqrt(max(1.0 - (p / 9.3) ** 2, 0.0))
    below = 0.5 * (across + 1.0) * gap
    groove = 1.0 - 0.12 * np.exp(-(((p - 1.9 * np.round(p / 1.9)) / 0.25) ** 2))
    tongue = (2.2 * lens - (gap - below)) * min(max((gap - 4.0) / 2.0, 0.0), 1.0)
    teeth = (
        min((2.7 - below) / 0.4 + 0.5, 1.0)
        * (1.0 - 0.5 * (p / 8.0) ** 2)
        * min(max(gap - 0.9, 0.0) / 0.9, 1.0)
    )
    parted = min(max((gap - 0.8) / 0.7, 0.0), 1.0)
    cover = (1.08 - abs(across)) / 0.25 * min(lens * 2.5, 1.0) * (0.85 + 0.15 * parted)
    for k in range(3):
        value = _mixed(_mixed(_DARK[k], _TONGUE[k], tongue), _TOOTH[k] * groove, teeth)
        colour[k] = _mixed(colour[k], _mixed(0.38 * lips[k], value, parted), cover)
    if cover > 0.5 and parted > 0.5:
        part[0] = _MOUTH


@kernel
@no_type_check
def _mixed(value, other, alpha):
    return value + (other - value) * min(max(alpha, 0.0), 1.0)
