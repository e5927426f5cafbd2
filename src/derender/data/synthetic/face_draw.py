"""The random draw of one image of a face: person, expression, lighting, viewpoint, background.

A draw is a function of seed and index alone. In a track (settings.tracks) light, background and expression
belong to the track, while view, gaze and the expression's strength move from one draw to another along its
frames.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from derender.data.synthetic.face_shape import ACTIONS, LID_ACTIONS
from derender.data.synthetic.settings import (
    EXPRESSIONS,
    FaceSettings,
    Range,
    ViewSettings,
    clipped,
    either_side,
    name_at,
    scaled,
)
from derender.data.synthetic.synthetic_set import draw_background

NOSE_TIP_Z = 0.947  # of neutral faces
_DRIFT = np.array([*np.deg2rad([8.0, 18.0, 5.0]), 0.005, 0.005, 0.0])  # how far a head moves within a track
_JAW = ACTIONS.index("jaw_open")


@dataclass(frozen=True)
class FaceDraw:
    """One image's draw: ``actions`` and ``lids`` are weights of each half of the face's actions, ``gaze`` is
    in face pixels, ``light`` and ``camera`` as in SyntheticSet."""

    identity: int
    track: int
    frame: int
    expression: str
    strength: float
    actions: Float32[ndarray, "actions 2"]
    lids: Float32[ndarray, "2 2"]
    gaze: Float32[ndarray, "2"]
    light: Float32[ndarray, "4"]
    camera: Float32[ndarray, "6"]
    background: Float32[ndarray, "s s 3"]


def draw_face(seed: int, index: int, image_size: int, settings: FaceSettings) -> FaceDraw:
    """The draw of image number ``index``."""
    person, within = divmod(index, settings.per_identity)
    track, frame = divmod(within, settings.frames) if settings.tracks else (0, 0)
    generator = np.random.default_rng([seed, 1, index - frame])  # a track's is that of its first frame
    normal = generator.standard_normal((2, 7))
    uniform = generator.random(8)
    ends = generator.random((2, 4))
    halves = generator.standard_normal((len(ACTIONS) + len(LID_ACTIONS), 2))
    name = name_at(settings.expressions, uniform[0])
    along = frame / max(settings.frames - 1, 1) if settings.tracks else 0.0
    strengths = np.array([[scaled(settings.strength, share)] for share in ends[:, 3]])
    strength = 0.0 if name == "neutral" else float(_moved(strengths, along)[0])
    weights = np.array([EXPRESSIONS[name].get(action, 0.0) for action in (*ACTIONS, *LID_ACTIONS)])
    sides = strength * weights[:, None] * (1.0 + settings.asymmetry * halves)
    sides[len(ACTIONS) :] += 0.5 * settings.asymmetry * halves[len(ACTIONS) :, :1]
    sides[_JAW] = sides[_JAW].mean()  # a jaw opens as a whole
    cameras = np.stack([_camera(settings.view, n, u) for n, u in zip(normal, ends, strict=True)])
    if settings.tracks:
        cameras[1] = np.clip(cameras[1], cameras[0] - _DRIFT, cameras[0] + _DRIFT)
    gaze = np.clip(normal[:, 5:], -1.8, 1.8) * settings.gaze_px * np.array([1.0, 0.35])
    kind = settings.backgrounds[int(uniform[6] * len(settings.backgrounds))]
    return FaceDraw(
        identity=settings.first_identity + person,
        track=track,
        frame=frame,
        expression=name,
        strength=strength,
        actions=sides[: len(ACTIONS)].astype(np.float32),
        lids=sides[len(ACTIONS) :].astype(np.float32),
        gaze=_moved(gaze, along).astype(np.float32),
        light=settings.light.draw(uniform[1:6]),
        camera=_moved(cameras, along).astype(np.float32),
        background=draw_background(kind, generator, image_size),
    )


def _camera(view: ViewSettings, normal: ndarray, uniform: ndarray) -> ndarray:
    pitch = _angle(view.pitch_deg, view.pitch_sd_deg, normal[0], uniform[0])
    yaw = _angle(view.yaw_deg, view.yaw_sd_deg, normal[1], uniform[1])
    if view.yaw_beyond_deg > 0:
        yaw = either_side(view.yaw_deg, view.yaw_beyond_deg, uniform[1])
    roll = _angle(view.roll_deg, view.roll_sd_deg, normal[2], uniform[2])
    shift = [_angle(view.shift, view.shift_sd, normal[k], uniform[k - 3]) for k in (3, 4)]
    return np.array([*np.deg2rad([pitch, yaw, roll]), *shift, 0.0])


def _angle(ends: Range, sd: float | None, normal: float, uniform: float) -> float:
    """A normal about the middle, clipped at the ends; uniform without a standard deviation."""
    if sd is None:
        return scaled(ends, uniform)
    return clipped(0.5 * (ends[0] + ends[1]) + sd * normal, ends)


def _moved(ends: ndarray, along: float) -> ndarray:
    """Between two draws, smoothly in time (0..1)."""
    return ends[0] + (ends[1] - ends[0]) * (along * along * (3.0 - 2.0 * along))
