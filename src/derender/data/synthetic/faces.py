"""Generated faces: identity, expression, light and view are drawn, the face is pictured with exact truth.

Each picture is a function of the seed and its index alone: asking for more pictures does not change the
first ones, nor does the number of threads. Conventions are those of docs/conventions.md; nose tips of neutral
faces stand at z = 0.947.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy import ndarray

from derender.data.celebamask import MASK_CLASSES
from derender.data.synthetic.batches import FOV_DEG, Maps, Row, check_request, make_set
from derender.data.synthetic.face_draw import FaceDraw, draw_face
from derender.data.synthetic.face_procedural import NOSE_TIP_Z as NOSE_TIP_Z
from derender.data.synthetic.face_procedural import ProceduralFaces
from derender.data.synthetic.mesh_picture import draw_meshes
from derender.data.synthetic.morphable import MorphableFaces
from derender.data.synthetic.settings import FaceSettings
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.scene.camera import focal_px


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
    check_request(count, image_size, seed, first)
    source = _family(model, image_size)
    source.prepare()
    triangles = source.triangles

    def work(indices: range, maps: Maps) -> list[tuple[Row, Row]]:
        draws = [draw_face(seed, index, image_size, settings) for index in indices]
        people = {
            number: source.person(seed, number, settings) for number in sorted({d.identity for d in draws})
        }
        _picture(draws, *source.meshes(draws, people), triangles, image_size, maps)
        known = {number: (source.labels(who), source.traits(who)) for number, who in people.items()}
        return [({**_labels(d, settings), **known[d.identity][0]}, {**known[d.identity][1]}) for d in draws]

    return make_set(work, count, image_size, first, settings.per_identity, MASK_CLASSES, progress)


def _family(model: MorphableFaces | str | Path | None, image_size: int) -> FaceModel:
    if model is None:
        return ProceduralFaces(_detail(image_size))
    return model if isinstance(model, MorphableFaces) else MorphableFaces.read(model)


def _picture(
    draws: list[FaceDraw],
    vertices: ndarray,
    albedo: ndarray,
    parts: ndarray,
    triangles: ndarray,
    size: int,
    out: Maps,
) -> None:
    """Draw the meshes of one batch into ``out``."""
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


def _detail(image_size: int) -> float:
    """Grid detail that suits a picture size."""
    return float(np.clip(np.ceil(image_size / 64 * 2) / 2, 1.0, 3.0))
