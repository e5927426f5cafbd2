"""Procedural faces: identity, expression, light and view are drawn, the face is pictured with exact truth.

Each picture is a function of the seed and its index alone: asking for more pictures does not change the
first ones. Conventions are those of docs/conventions.md; nose tips of neutral faces stand at z = 0.947.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy import ndarray

from derender.data.synthetic.backgrounds import draw_background
from derender.data.synthetic.face_expression import ACTIONS, EXPRESSIONS, LID_ACTIONS, expression_basis
from derender.data.synthetic.face_features import paint_features
from derender.data.synthetic.face_grid import MOUTH_BAND, MOUTH_Q, face_grid, smoothstep
from derender.data.synthetic.face_identity import FaceIdentity, draw_identity
from derender.data.synthetic.face_shape import bare_head, shape_basis
from derender.data.synthetic.face_skin import ear_share, paint_skin
from derender.data.synthetic.mesh_picture import draw_meshes
from derender.data.synthetic.settings import FaceSettings
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.render.numba_threads import kernel
from derender.scene.camera import focal_px

FOV_DEG = 10.0
NOSE_TIP_Z = 0.947
_FACE_PX = float(np.tan(np.deg2rad(FOV_DEG / 2)) / 31.5)  # scene units per face pixel at z = 1
_DOWN_PX = 1.6  # the face sits this much below the middle, so that hair shows
_CHUNK = 16


def generate(
    count: int,
    image_size: int = 64,
    seed: int = 0,
    settings: FaceSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    first: int = 0,
) -> SyntheticSet:
    """``count`` pictures, from index ``first`` on; ``progress(done, count)`` is called as they are made."""
    settings = settings or FaceSettings()
    _check(count, image_size, seed, first)
    detail = _detail(image_size)
    out = _empty(count, image_size)
    traits: list[dict[str, float]] = []
    for shared in (_outward, expression_basis):  # computed once, before threads ask for them
        shared(detail)

    def work(rows: slice) -> list[dict[str, float]]:
        draws = [_draw(seed, first + i, image_size, settings) for i in range(rows.start, rows.stop)]
        people = {number: _person(seed, number, detail) for number in sorted({d.identity for d in draws})}
        _picture(draws, people, detail, image_size, {name: value[rows] for name, value in out.items()})
        rows_of = {number: person.who.vector() for number, person in people.items()}
        return [rows_of[d.identity] for d in draws]

    chunks = _chunks(first, count, settings.pictures_per_identity, max(1, _CHUNK * 64 // image_size))
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for rows, found in zip(chunks, pool.map(work, chunks), strict=True):
            traits.extend(found)
            if progress is not None:
                progress(rows.stop, count)
    by_name = {name: np.array([row[name] for row in traits], np.float32) for name in traits[0]}
    return SyntheticSet(**out, identity_traits=by_name, fov_deg=FOV_DEG)


def _chunks(first: int, count: int, per_identity: int, most: int) -> list[slice]:
    """Consecutive rows to work on together: whole identities where they fit into ``most`` rows."""
    whole = max(1, most // per_identity) * per_identity
    starts = [0]
    while starts[-1] < count:
        in_block = (first + starts[-1]) % whole
        starts.append(min(starts[-1] + min(whole - in_block, most), count))
    return [slice(a, b) for a, b in itertools.pairwise(starts)]


@dataclass(frozen=True)
class _Draw:
    """What is drawn for one picture."""

    identity: int
    expression: str
    strength: float
    actions: Float32[ndarray, "actions 2"]
    lids: Float32[ndarray, "2 2"]
    gaze: Float32[ndarray, "2"]
    light: Float32[ndarray, "4"]
    camera: Float32[ndarray, "6"]
    background: Float32[ndarray, "s s 3"]


@dataclass(frozen=True)
class _Person:
    """One identity's neutral surface (face pixels) and skin."""

    who: FaceIdentity
    surface: Float32[ndarray, "rows columns 3"]
    albedo: Float32[ndarray, "rows columns 3"]
    nose_tip: float


def _draw(seed: int, index: int, image_size: int, settings: FaceSettings) -> _Draw:
    generator = np.random.default_rng([seed, 1, index])
    normal = generator.standard_normal(7)
    uniform = generator.random(8)
    halves = generator.standard_normal((len(ACTIONS) + len(LID_ACTIONS), 2))
    name = settings.expressions[int(uniform[0] * len(settings.expressions))]
    strength = 0.0 if name == "neutral" else _scaled(settings.strength, uniform[1])
    weights = np.array([EXPRESSIONS[name].get(action, 0.0) for action in (*ACTIONS, *LID_ACTIONS)])
    sides = strength * weights[:, None] * (1.0 + settings.asymmetry * halves)
    sides[len(ACTIONS) :] += 0.5 * settings.asymmetry * halves[len(ACTIONS) :, :1]
    limits = np.deg2rad([settings.pitch_limit_deg, settings.yaw_limit_deg, settings.roll_limit_deg])
    means = np.deg2rad([settings.pitch_mean_deg, settings.yaw_mean_deg, 0.0])
    spreads = np.deg2rad([settings.pitch_sd_deg, settings.yaw_sd_deg, settings.roll_sd_deg])
    rotation = means + np.clip(normal[:3] * spreads, -limits, limits)
    shift = np.clip(
        normal[3:5] * settings.translation_sd, -settings.translation_limit, settings.translation_limit
    )
    light = [
        _scaled(settings.ambient, uniform[2]),
        _scaled(settings.diffuse, uniform[3]),
        np.deg2rad(_scaled(settings.light_pitch_deg, uniform[4])),
        np.deg2rad(_scaled(settings.light_yaw_deg, uniform[5])),
    ]
    kind = settings.backgrounds[int(uniform[6] * len(settings.backgrounds))]
    return _Draw(
        identity=index // settings.pictures_per_identity,
        expression=name,
        strength=strength,
        actions=sides[: len(ACTIONS)].astype(np.float32),
        lids=sides[len(ACTIONS) :].astype(np.float32),
        gaze=(np.clip(normal[5:], -1.8, 1.8) * settings.gaze_px * np.array([1.0, 0.35])).astype(np.float32),
        light=np.array(light, np.float32),
        camera=np.array([*rotation, *shift, 0.0], np.float32),
        background=draw_background(kind, generator, image_size),
    )


def _person(seed: int, identity: int, detail: float) -> _Person:
    basis = shape_basis(detail)
    who = draw_identity(np.random.default_rng([seed, 2, identity]), basis.names)
    surface = basis.mean.copy()
    for name, mode in zip(basis.names, basis.modes, strict=True):
        surface += np.float32(who.shape[name]) * mode
    albedo, hair = paint_skin(who, detail)
    surface += np.float32(ear_share(who)) * basis.ear
    surface += (hair[..., None] * _outward(detail)).astype(np.float32)
    surface *= np.float32(who.scale)
    return _Person(who, surface, albedo.astype(np.float32), float(surface[..., 2].min()))


@lru_cache(maxsize=4)
def _outward(detail: float) -> ndarray:
    """Unit vectors out of the bare head: its normals, level below the ears, where hair hangs."""
    grid = face_grid(detail)
    head = bare_head(grid)
    normal = np.cross(np.gradient(head, axis=0), np.gradient(head, axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    level = np.stack([np.sin(grid.theta), np.zeros(grid.shape), -np.cos(grid.theta)], axis=-1)
    low = smoothstep(2.0, 20.0, grid.q)[..., None]
    out = (1.0 - low) * normal + low * level
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-9)


def _picture(
    draws: list[_Draw], people: dict[int, _Person], detail: float, size: int, out: dict[str, ndarray]
) -> None:
    """Assemble the faces of one chunk and draw them into ``out``."""
    grid = face_grid(detail)
    numbers = list(people)
    who = np.array([numbers.index(d.identity) for d in draws])
    base = np.stack([people[k].surface for k in numbers])
    scale = np.array([people[d.identity].who.scale for d in draws], np.float32)
    tip = np.array([people[d.identity].nose_tip for d in draws], np.float32)
    actions = np.stack([d.actions for d in draws])
    vertices = np.empty((len(draws), *base.shape[1:]), np.float32)
    q = grid.q[:, 0]
    top, bottom = np.searchsorted(q, [MOUTH_Q - MOUTH_BAND, MOUTH_Q + MOUTH_BAND])
    gap = np.empty((len(draws), base.shape[2]), np.float32)
    _assemble(base, who, actions, expression_basis(detail).fields, scale, tip, vertices, top - 1, bottom, gap)
    albedo = np.stack([people[k].albedo for k in numbers])[who]
    eyes = np.array([_lids(people[d.identity].who, d.lids) for d in draws])
    traits = [people[d.identity].who for d in draws]
    paint_features(
        albedo, grid.p[0], q, gap, eyes, np.stack([w.iris for w in traits]),
        np.stack([w.lips for w in traits]), np.stack([d.gaze for d in draws]),
    )  # fmt: skip
    camera = np.stack([d.camera for d in draws])
    light = np.stack([d.light for d in draws])
    rotation, direction = camera_rotation_and_light(camera, light)
    draw_meshes(
        vertices, albedo, rotation.astype(np.float32), camera[:, 3:],
        np.hstack([light[:, :2], direction]).astype(np.float32), np.stack([d.background for d in draws]),
        size, np.float32(focal_px(size, FOV_DEG)),
        out["images"], out["depth"], out["normal"], out["albedo"], out["mask"],
    )  # fmt: skip
    out["light"][:], out["camera"][:] = light, camera
    out["identity"][:] = [d.identity for d in draws]
    out["expression"][:] = [d.expression for d in draws]
    out["strength"][:] = [d.strength for d in draws]


@kernel
@no_type_check
def _assemble(base, who, actions, fields, scale, tip, vertices, top, bottom, gap):
    """Add expressions to neutral surfaces, move to scene units, and measure how far the lips have parted."""
    rows, columns = base.shape[1], base.shape[2]
    for n in range(len(who)):
        vertices[n] = base[who[n]]
        for a in range(actions.shape[1]):
            for side in range(2):
                weight = actions[n, a, side] * scale[n]
                if weight != 0.0:
                    for r in range(rows):
                        for c in range(columns):
                            for k in range(3):
                                vertices[n, r, c, k] += weight * fields[a, side, r, c, k]
        for c in range(columns):
            gap[n, c] = (vertices[n, bottom, c, 1] - vertices[n, top, c, 1]) / scale[n]
        for r in range(rows):
            for c in range(columns):
                vertices[n, r, c, 0] *= np.float32(_FACE_PX)
                vertices[n, r, c, 1] = np.float32(_FACE_PX) * (vertices[n, r, c, 1] + np.float32(_DOWN_PX))
                vertices[n, r, c, 2] = np.float32(NOSE_TIP_Z) + np.float32(_FACE_PX) * (
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


def _scaled(ends: tuple[float, float], share: float) -> float:
    return float(ends[0] + (ends[1] - ends[0]) * share)


def _detail(image_size: int) -> float:
    """Grid detail that suits a picture size."""
    return float(np.clip(np.ceil(image_size / 64 * 2) / 2, 1.0, 3.0))


def _empty(count: int, size: int) -> dict[str, ndarray]:
    return {
        "images": np.zeros((count, 3, size, size), np.uint8),
        "depth": np.zeros((count, size, size), np.float32),
        "normal": np.zeros((count, size, size, 3), np.float32),
        "albedo": np.zeros((count, 3, size, size), np.uint8),
        "mask": np.zeros((count, size, size), bool),
        "light": np.zeros((count, 4), np.float32),
        "camera": np.zeros((count, 6), np.float32),
        "identity": np.zeros(count, np.int64),
        "expression": np.zeros(count, "<U8"),
        "strength": np.zeros(count, np.float32),
    }


def _check(count: int, image_size: int, seed: int, first: int) -> None:
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    if not 16 <= image_size <= 1024:
        raise ValueError(f"image_size must be 16..1024 pixels, got {image_size}")
    if seed < 0 or first < 0:
        raise ValueError(f"seed and first must be 0 or more, got seed {seed}, first {first}")
