"""The built-in face model: an identity's surface and skin, and one mesh per picture with expression and eyes.

The mesh is the grid of face_grid; the user's own morphable model (morphable) offers the same two functions.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from numpy import ndarray

from derender.data.synthetic.face_draw import FaceDraw
from derender.data.synthetic.face_expression import expression_basis
from derender.data.synthetic.face_features import paint_features
from derender.data.synthetic.face_grid import MOUTH_BAND, MOUTH_Q, face_grid, grid_triangles, smoothstep
from derender.data.synthetic.face_identity import FaceIdentity, draw_identity
from derender.data.synthetic.face_shape import bare_head, shape_basis
from derender.data.synthetic.face_skin import Skin, ear_share, paint_skin
from derender.data.synthetic.settings import FaceSettings
from derender.render.numba_threads import kernel

NOSE_TIP_Z = 0.947
FACE_PX = float(np.tan(np.deg2rad(5.0)) / 31.5)  # scene units per face pixel at z = 1
_DOWN_PX = 2.6  # the face sits this much below the middle, so that hair shows


@dataclass(frozen=True)
class Person:
    """One identity's neutral surface (face pixels) and skin."""

    who: FaceIdentity
    surface: Float32[ndarray, "rows columns 3"]
    skin: Skin
    nose_tip: float


@dataclass(frozen=True)
class ProceduralFaces:
    """The built-in model at the grid detail that suits a picture size."""

    detail: float

    @property
    def triangles(self) -> Int32[ndarray, "f 3"]:
        return grid_triangles(*face_grid(self.detail).shape)

    def prepare(self) -> None:
        """Compute what all pictures share, before threads ask for it."""
        _outward(self.detail)
        expression_basis(self.detail)

    def person(self, seed: int, identity: int, settings: FaceSettings) -> Person:
        """One identity; a function of seed, number and the settings' ranges of age and skin tone."""
        basis = shape_basis(self.detail)
        generator = np.random.default_rng([seed, 2, identity])
        who = draw_identity(generator, basis.names, settings.age_years, settings.skin_tone)
        coefficients = np.array([who.shape[name] for name in basis.names], np.float32)
        surface = basis.mean.copy()
        for coefficient, mode in zip(coefficients, basis.modes, strict=True):
            surface += coefficient * mode
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
        """The columns of params.csv that say who is seen."""
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
        grid, basis = face_grid(self.detail), expression_basis(self.detail)
        shown = [people[d.identity] for d in draws]
        numbers = list(people)
        who = np.array([numbers.index(d.identity) for d in draws])
        q = grid.q[:, 0]
        top, bottom = np.searchsorted(q, [MOUTH_Q - MOUTH_BAND, MOUTH_Q + MOUTH_BAND])
        vertices = np.empty((len(draws), *grid.shape, 3), np.float32)
        gap = np.empty((len(draws), grid.shape[1]), np.float32)
        _assemble(
            np.stack([people[k].surface for k in numbers]), who, np.stack([d.actions for d in draws]),
            basis.fields, basis.boxes, np.array([p.who.scale for p in shown], np.float32),
            np.array([p.nose_tip for p in shown], np.float32), vertices, top - 1, bottom, gap,
        )  # fmt: skip
        albedo = np.stack([people[k].skin.albedo for k in numbers])[who]
        parts = np.stack([people[k].skin.parts for k in numbers])[who]
        lids = np.array([_lids(p.who, d.lids) for p, d in zip(shown, draws, strict=True)])
        paint_features(
            albedo, parts, grid.p[0], q, gap, lids,
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
    normal = np.cross(np.gradient(head, axis=0), np.gradient(head, axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    level = np.stack([np.sin(grid.theta), np.zeros(grid.shape), -np.cos(grid.theta)], axis=-1)
    low = smoothstep(2.0, 20.0, grid.q)[..., None]
    out = (1.0 - low) * normal + low * level
    return (out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-9)).astype(np.float32)


@kernel
@no_type_check
def _assemble(base, who, actions, fields, boxes, scale, tip, vertices, top, bottom, gap):
    """Add expressions to neutral surfaces, move to scene units, and measure how far the lips have parted."""
    rows, columns = base.shape[1], base.shape[2]
    for n in range(len(who)):
        vertices[n] = base[who[n]]
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
        for c in range(columns):
            gap[n, c] = (vertices[n, bottom, c, 1] - vertices[n, top, c, 1]) / scale[n]
        for r in range(rows):
            for c in range(columns):
                vertices[n, r, c, 0] *= np.float32(FACE_PX)
                vertices[n, r, c, 1] = np.float32(FACE_PX) * (vertices[n, r, c, 1] + np.float32(_DOWN_PX))
                vertices[n, r, c, 2] = np.float32(NOSE_TIP_Z) + np.float32(FACE_PX) * (
                    vertices[n, r, c, 2] - tip[n]
                )


def _lids(who: FaceIdentity, lids: Float32[ndarray, "2 2"]) -> Float64[ndarray, "8"]:
    """The row that paint_features wants."""
    wide, squint = lids
    opening = np.clip(who.eye_opening * (1.0 + 0.34 * wide - 0.42 * squint), 0.25, 1.7)
    low = np.clip(who.eye_opening * (1.0 + 0.2 * wide - 0.45 * squint), 0.2, 1.5)
    up = 2.35 * opening
    low = 1.4 * low
    tail = (who.eye_tilt, who.lashes, who.lid_crease)
    return np.array([who.eye_length, up[0], low[0], up[1], low[1], *tail], np.float64)
