"""Generated faces: identity, expression, light and view are drawn, the face is rendered with exact truth.

Each image is a function of the seed and its index alone: asking for more images does not change the first
ones, nor does the number of threads. Conventions are those of docs/conventions.md; nose tips of neutral faces
stand at z = 0.947.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy import ndarray

from derender.data import MASK_CLASSES
from derender.data.synthetic.decals import paint_table
from derender.data.synthetic.face_draw import NOSE_TIP_Z as NOSE_TIP_Z
from derender.data.synthetic.face_draw import FaceDraw, draw_face
from derender.data.synthetic.face_mesh import ProceduralFaces
from derender.data.synthetic.mesh_image import TriangleMesh, draw_meshes
from derender.data.synthetic.morphable import MorphableFaces
from derender.data.synthetic.settings import FaceSettings
from derender.data.synthetic.synthetic_set import Maps, Row, SyntheticSet, make_set


@runtime_checkable
class FaceModel(Protocol):
    """The methods of a family of faces that ``generate`` calls; only they look into a person."""

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
    """``count`` images, from index ``first`` on; ``progress(done, count)`` is called as they are made.

    ``model`` replaces the built-in faces by those of a morphable model (a file as in ``morphable``).
    """
    settings = settings or FaceSettings()
    source = _family(model, image_size)
    no_paint = paint_table([])

    def work(indices: range, maps: Maps) -> list[tuple[Row, Row]]:
        draws = [draw_face(seed, index, image_size, settings) for index in indices]
        numbers = sorted({d.identity for d in draws})
        people = {number: source.person(seed, number, settings) for number in numbers}
        for name in ("light", "camera", "identity"):
            maps[name][:] = [getattr(d, name) for d in draws]
        meshes = [
            TriangleMesh(v, source.triangles, a, p)
            for v, a, p in zip(*source.meshes(draws, people), strict=True)
        ]
        draw_meshes([(mesh, no_paint) for mesh in meshes], 1.0, [d.background for d in draws], maps)
        rows = {number: (source.labels(who), source.traits(who)) for number, who in people.items()}
        return [({**_labels(d, settings), **rows[d.identity][0]}, {**rows[d.identity][1]}) for d in draws]

    per_identity = settings.per_identity
    return make_set(
        work, source.prepare, count, image_size, seed, first, per_identity, MASK_CLASSES, progress
    )


def _family(model: MorphableFaces | str | Path | None, image_size: int) -> FaceModel:
    if model is None:
        detail = np.ceil(image_size / 64 * 2) / 2  # of the grid
        return ProceduralFaces(float(np.clip(detail, 1.0, 3.0)))
    return model if isinstance(model, MorphableFaces) else MorphableFaces.read(model)


def _labels(draw: FaceDraw, settings: FaceSettings) -> Row:
    row: Row = {"expression": draw.expression, "strength": draw.strength}
    if not settings.tracks:
        return row
    kind = "yaw" if abs(draw.light[3]) >= abs(draw.light[2]) else "pitch"
    return {"track": draw.track, "frame": draw.frame, **row, "light_kind": kind}
