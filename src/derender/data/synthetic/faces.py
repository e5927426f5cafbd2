"""Generated faces: identity, expression, light and view are drawn, the face is pictured with exact truth.

Each picture is a function of the seed and its index alone: asking for more pictures does not change the
first ones, nor does the number of threads. Conventions are those of docs/conventions.md; nose tips of neutral
faces stand at z = 0.947.
"""

import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy import ndarray

from derender.data.celebamask import MASK_CLASSES
from derender.data.synthetic.face_draw import FaceDraw, draw_face
from derender.data.synthetic.face_procedural import NOSE_TIP_Z as NOSE_TIP_Z
from derender.data.synthetic.face_procedural import ProceduralFaces
from derender.data.synthetic.mesh_picture import draw_meshes
from derender.data.synthetic.morphable import MorphableFaces
from derender.data.synthetic.settings import FaceSettings
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.scene.camera import focal_px

FOV_DEG = 10.0
Row = dict[str, int | float | str]
_CHUNK = 16


@runtime_checkable
class FaceModel(Protocol):
    """What ``generate`` asks of a family of faces; a person is whatever its own functions understand."""

    @property
    def triangles(self) -> ndarray: ...

    def prepare(self) -> None: ...
    def person(self, seed: int, identity: int, settings: FaceSettings) -> Any: ...
    def labels(self, person: Any) -> Mapping[str, float | str]: ...
    def traits(self, person: Any) -> Mapping[str, float | str]: ...
    def meshes(self, draws: list[FaceDraw], people: dict[int, Any]) -> tuple[ndarray, ndarray, ndarray]: ...


def generate(
    count: int,
    image_size: int = 64,
    seed: int = 0,
    settings: FaceSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    first: int = 0,
    model: MorphableFaces | str | Path | None = None,
) -> SyntheticSet:
    """``count`` pictures, from index ``first`` on; ``progress(done, count)`` is called as they are made.

    ``model`` replaces the built-in faces by those of a morphable model (a file as in ``morphable``).
    """
    settings = settings or FaceSettings()
    _check(count, image_size, seed, first)
    source = _family(model, image_size)
    source.prepare()
    triangles = source.triangles
    out = _empty(count, image_size)
    labels: list[Row] = []
    traits: list[Row] = []

    def work(rows: slice) -> list[tuple[Row, Row]]:
        draws = [draw_face(seed, first + i, image_size, settings) for i in range(rows.start, rows.stop)]
        people = {
            number: source.person(seed, number, settings) for number in sorted({d.identity for d in draws})
        }
        vertices, albedo, parts = source.meshes(draws, people)
        part_of = {name: value[rows] for name, value in out.items()}
        _picture(draws, vertices, albedo, parts, triangles, image_size, part_of)
        known = {number: (source.labels(who), source.traits(who)) for number, who in people.items()}
        return [({**_labels(d, settings), **known[d.identity][0]}, {**known[d.identity][1]}) for d in draws]

    chunks = _chunks(first, count, settings.per_identity, max(1, _CHUNK * 64 // image_size))
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for rows, found in zip(chunks, pool.map(work, chunks), strict=True):
            labels += [label for label, _ in found]
            traits += [trait for _, trait in found]
            if progress is not None:
                progress(rows.stop, count)
    return SyntheticSet(
        **out,
        labels=_columns(labels),
        identity_traits=_columns(traits),
        part_names=MASK_CLASSES,
        fov_deg=FOV_DEG,
    )


def _family(model: MorphableFaces | str | Path | None, image_size: int) -> FaceModel:
    if model is None:
        return ProceduralFaces(_detail(image_size))
    return model if isinstance(model, MorphableFaces) else MorphableFaces.read(model)


def _chunks(first: int, count: int, per_identity: int, most: int) -> list[slice]:
    """Consecutive rows to work on together: whole identities where they fit into ``most`` rows."""
    whole = max(1, most // per_identity) * per_identity
    starts = [0]
    while starts[-1] < count:
        in_block = (first + starts[-1]) % whole
        starts.append(min(starts[-1] + min(whole - in_block, most), count))
    return [slice(a, b) for a, b in itertools.pairwise(starts)]


def _picture(
    draws: list[FaceDraw],
    vertices: ndarray,
    albedo: ndarray,
    parts: ndarray,
    triangles: ndarray,
    size: int,
    out: dict[str, ndarray],
) -> None:
    """Draw the meshes of one chunk into ``out``."""
    camera = np.stack([d.camera for d in draws])
    light = np.stack([d.light for d in draws])
    rotation, direction = camera_rotation_and_light(camera, light)
    draw_meshes(
        vertices, albedo, parts, triangles, rotation.astype(np.float32), camera[:, 3:],
        np.hstack([light[:, :2], direction]).astype(np.float32), np.stack([d.background for d in draws]),
        size, np.float32(focal_px(size, FOV_DEG)),
        out["images"], out["depth"], out["normal"], out["albedo"], out["mask"], out["parts"],
    )  # fmt: skip
    out["light"][:], out["camera"][:] = light, camera
    out["identity"][:] = [d.identity for d in draws]


def _labels(draw: FaceDraw, settings: FaceSettings) -> Row:
    row: Row = {"expression": draw.expression, "strength": draw.strength}
    if not settings.tracks:
        return row
    kind = "yaw" if abs(draw.light[3]) >= abs(draw.light[2]) else "pitch"
    return {"track": draw.track, "frame": draw.frame, **row, "light_kind": kind}


def _columns(rows: list[Row]) -> dict[str, ndarray]:
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


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
        "parts": np.zeros((count, size, size), np.uint8),
        "light": np.zeros((count, 4), np.float32),
        "camera": np.zeros((count, 6), np.float32),
        "identity": np.zeros(count, np.int64),
    }


def _check(count: int, image_size: int, seed: int, first: int) -> None:
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    if not 16 <= image_size <= 1024:
        raise ValueError(f"image_size must be 16..1024 pixels, got {image_size}")
    if seed < 0 or first < 0:
        raise ValueError(f"seed and first must be 0 or more, got seed {seed}, first {first}")
