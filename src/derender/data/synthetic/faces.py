"""Generated faces: identity, expression, light and view are drawn, the face is rendered with exact truth.

Each image is a function of the seed and its index alone: asking for more images does not change the first
ones, nor does the number of threads. In a track (settings.tracks) light, background and expression belong to
the track. View, gaze and the expression's strength move from one draw to another along its frames.
Conventions are those of docs/reference/conventions.md; nose tips of neutral faces stand at z = 0.947.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy import ndarray

from derender.data import MASK_CLASSES, Progress
from derender.data.synthetic.face_shape import ACTIONS, LID_ACTIONS, Expression, face_shape
from derender.data.synthetic.face_skin import built_in_person, skin_fields
from derender.data.synthetic.morphable import MeshOf, MorphableFaces
from derender.data.synthetic.settings import EXPRESSIONS, FaceSettings, ViewSettings, drawn, pick
from derender.data.synthetic.synthetic_set import Row, Shot, SyntheticSet, draw_background, make_set

_DRIFT = np.array([*np.deg2rad([8.0, 18.0, 5.0]), 0.005, 0.005, 0.0])  # how far a head moves within a track


def generate(
    count: int, image_size: int = 64, seed: int = 0, settings: FaceSettings | None = None,
    progress: Progress | None = None, first: int = 0,
    model: MorphableFaces | str | Path | None = None,
) -> SyntheticSet:  # fmt: skip
    """``count`` images, from index ``first`` on; ``progress(done, count)`` is called as they are made.

    ``model`` replaces the built-in faces by those of a morphable model (a file as in ``morphable``).
    """
    settings = settings or FaceSettings()
    if model is None:
        detail = float(np.clip(np.ceil(image_size / 64 * 2) / 2, 1.0, 3.0))  # of the grid
        person = partial(built_in_person, face_shape(detail), skin_fields(detail))
    else:
        person = (model if isinstance(model, MorphableFaces) else MorphableFaces.read(model)).person

    def shots(indices: list[int]) -> Iterator[Shot]:
        number = settings.first_identity + indices[0] // settings.per_identity
        made = person(seed, number, settings)
        return (draw_face(seed, index, image_size, settings, number, *made) for index in indices)

    size = settings.per_identity
    return make_set(shots, count, image_size, seed, first, size, MASK_CLASSES, progress, settings.effects)


def draw_face(
    seed: int, index: int, image_size: int, settings: FaceSettings, number: int, mesh_of: MeshOf, known: Row,
    traits: Row,
) -> Shot:  # fmt: skip
    """Image ``index`` of person ``number``: expression, light, view and background."""
    track, frame = divmod(index % settings.per_identity, settings.frames) if settings.tracks else (0, 0)
    along = frame / max(settings.frames - 1, 1)
    along = along * along * (3.0 - 2.0 * along)  # between two draws, smoothly in time
    generator = np.random.default_rng([seed, 1, index - frame])  # a track's is that of its first frame
    normal, uniform = generator.standard_normal((2, 7)), generator.random(8)
    ends, halves = generator.random((2, 4)), generator.standard_normal((len(ACTIONS) + len(LID_ACTIONS), 2))
    name = list(settings.expressions)[pick([*settings.expressions.values()], uniform[0])]
    strengths = [drawn(settings.strength, share) for share in ends[:, 3]]
    strength = 0.0 if name == "neutral" else strengths[0] + (strengths[1] - strengths[0]) * along
    weights = np.array([[EXPRESSIONS[name].get(action, 0.0)] for action in (*ACTIONS, *LID_ACTIONS)])
    sides = strength * weights * (1.0 + settings.asymmetry * halves)
    sides[len(ACTIONS) :] += 0.5 * settings.asymmetry * halves[len(ACTIONS) :, :1]
    sides[0] = 0.5 * sum(sides[0])  # a jaw opens as a whole
    cameras = np.stack([_camera(settings.view, n, u) for n, u in zip(normal, ends, strict=True)])
    cameras[1] = np.clip(cameras[1], cameras[0] - _DRIFT, cameras[0] + _DRIFT)
    gaze = np.clip(normal[:, 5:], -1.8, 1.8) * settings.gaze_px * np.array([1.0, 0.35])
    camera, gaze = (start + (end - start) * along for start, end in (cameras, gaze))
    light = settings.light.draw(uniform[1:6])
    labels: Row = {"expression": name, "strength": strength}
    if settings.tracks:
        side = "yaw" if abs(light[3]) >= abs(light[2]) else "pitch"
        labels = {"track": track, "frame": frame, **labels, "light_kind": side}
    mesh = mesh_of(Expression(name, strength, sides.astype(np.float32), gaze.astype(np.float32)))
    kind = settings.backgrounds[int(uniform[6] * len(settings.backgrounds))]
    background = draw_background(kind, generator, image_size)
    return Shot(mesh, background, light, camera.astype(np.float32), number, labels | known, traits)


def _camera(view: ViewSettings, normal: ndarray, uniform: ndarray) -> ndarray:
    ranges = (view.pitch_deg, view.yaw_deg, view.roll_deg, view.shift, view.shift)
    spreads = (view.pitch_sd_deg, view.yaw_sd_deg, view.roll_sd_deg, view.shift_sd, view.shift_sd)
    values = [
        drawn(ends, share) if sd is None else min(max(0.5 * sum(ends) + sd * z, ends[0]), ends[1])
        for ends, sd, z, share in zip(ranges, spreads, normal, uniform[[0, 1, 2, 0, 1]], strict=False)
    ]
    if view.yaw_beyond_deg > 0:
        values[1] = drawn(view.yaw_deg, uniform[1], view.yaw_beyond_deg)
    return np.array([*np.deg2rad(values[:3]), *values[3:], 0.0])
