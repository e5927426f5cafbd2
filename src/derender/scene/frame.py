"""What a picture shows in another frame: the same scene, from a camera elsewhere or turned."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from derender.scene.camera import focal_px
from derender.scene.ranges import SceneRanges
from derender.scene.scene import Scene

_REACH = 0.75  # of a range: towards its end a network's output hardly moves


def seen_in_frame(scene: Scene, frames: Float[Tensor, "n 2 3"], fov_deg: float) -> Scene:
    """Scenes whose pictures are these scenes' pictures in other frames.

    A larger frame is a camera further away, a frame beside the middle one beside the thing, a turned one a
    camera turned about its axis. Right for what lies as far away as the thing's middle; with a field of view
    of 10 degrees the rest is off by less than a pixel.

    Args:
        scene: n of them; further factors stay as they are.
        frames: where each frame's points lie in the picture, as affine map of coordinates from -1 to 1 across
            and down: similarities, as `training.reframe.draw_frames` draws them.
        fov_deg: field of view in which the scenes are seen.
    """
    width = scene.depth.shape[-1]
    frames, focal = frames.to(scene.camera), focal_px(width, fov_deg) * 2 / width
    cosine, sine = frames[:, 0, 0], frames[:, 1, 0]
    scale, turn = torch.hypot(cosine, sine), torch.atan2(sine, cosine)
    distance = 1 + scene.camera[:, 5]
    x, y = (scene.camera[:, 3:5] - frames[:, :, 2] * distance[:, None] / focal).unbind(dim=1)
    moved = torch.stack(
        [
            *scene.camera[:, :2].unbind(dim=1),
            scene.camera[:, 2] - turn,
            (cosine * x + sine * y) / scale,
            (cosine * y - sine * x) / scale,
            scale * distance - 1,
        ],
        dim=1,
    )
    return scene.with_parameters(camera=moved)


def ranges_for_frames(
    ranges: SceneRanges, width: int, *, nearer: float, farther: float, shift: float
) -> SceneRanges:
    """Ranges whose camera can move as such frames ask for: never less than before.

    ``nearer`` and ``farther`` are the largest factors by which a thing is shown larger and smaller, ``shift``
    the largest move in half sides of a picture of ``width`` pixels.
    """
    focal = focal_px(width, ranges.fov_deg) * 2 / width
    away = max(farther - 1, 1 - 1 / nearer) / _REACH
    aside = math.sqrt(2) * shift * farther / focal / _REACH
    return ranges.model_copy(
        update={
            "translation_xy": max(ranges.translation_xy, aside),
            "translation_z": max(ranges.translation_z, away),
        }
    )
