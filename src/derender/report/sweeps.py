"""One scene under many lightings or from many viewpoints: for strips of stills and for films that loop.

A sweep is a function of places t between 0 and 1, of which ``there_and_back`` gives those of a film. Lights
are relative to the object (conventions.md), so the same light falls on the same side of every object,
however it is rotated. Films become bytes: animated PNG (all colours, transparency), GIF (256 colours a
frame), MP4 (H.264).
"""

from collections.abc import Callable
from math import inf, pi, radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageOps
from torch import Tensor

from derender.features import named
from derender.photo.edit import AMBIENT_SHARE, check_angles
from derender.photo.video import write_video
from derender.render import Rendering
from derender.report.colours import Images, image_bytes, on_background, pictures
from derender.report.panel import strip
from derender.scene import Scene

FRAMES_AT_ONCE = 8
LOOP_FRAMES, LOOP_LIGHT_DEG, LOOP_VIEW_DEG = 16, 45.0, 35.0

Render = Callable[[Scene], Rendering]


def there_and_back(frames: int) -> Float[Tensor, " k"]:
    """Places of a film that goes smoothly from 0 to 1 and back; the last frame leads to the first."""
    return (1 - _angles(frames).cos()) / 2


def lights_around(
    t: Float[Tensor, " k"], reach_deg: float, pitch_deg: float = 0.0, strength: float = 1.0
) -> Float[Tensor, "k 4"]:
    """Lights from the right of the image (t = 0) to its left (t = 1), ``reach_deg`` off the axis.

    ``strength`` is ambient plus diffuse light; with its own light's, an image stays as bright as it is.
    """
    pitch, yaw = _around(t, reach_deg, pitch_deg)
    if not 0 <= strength < inf:
        raise ValueError(f"the strength of a light must be 0 or more, got {strength}: give such a number")
    return _light(strength, pitch, yaw)


def cameras_around(t: Float[Tensor, " k"], reach_deg: float, pitch_deg: float = 0.0) -> Float[Tensor, "k 6"]:
    """Cameras for an object that looks to the right of the image (t = 0), then to its left (t = 1).

    ``pitch_deg`` > 0 brings its top forward. No shift, no roll: yaw 0 and pitch 0 show the canonical view.
    """
    pitch, yaw = _around(t, reach_deg, pitch_deg)
    return torch.stack((pitch, yaw, *[torch.zeros(len(t))] * 4), dim=1)


def varied(scene: Scene, **parameters: Tensor) -> Scene:
    """One scene once for each row of the given parameters, with those in place of its own."""
    count = len(next(iter(parameters.values())))
    repeated = scene.detach().map(lambda value: value.expand(count, *value.shape[1:]))
    return repeated.with_parameters(**{name: value.to(scene.depth) for name, value in parameters.items()})


def swapped(scene: Scene, donor: Scene, parameter: str) -> Scene:
    """The scenes with one parameter (depth, albedo, light, camera) of a single other scene."""
    value = named(donor.parameters, parameter, "parameter")
    return scene.with_parameters(**{parameter: value.expand(len(scene), *value.shape[1:])})


@torch.no_grad()
def drawn(scene: Scene, render: Render) -> Images:
    """Renderings as images, transparent where nothing is seen; few at a time, so that large ones fit."""
    images: Images = []
    for start in range(0, len(scene), FRAMES_AT_ONCE):
        rendering = render(scene[start : start + FRAMES_AT_ONCE])
        images += pictures(rendering.image, rendering.mask)
    return images


def circling_light(scene: Scene, frames: int = LOOP_FRAMES, reach_deg: float = LOOP_LIGHT_DEG) -> Scene:
    """One scene while a light as strong as its own goes round once, ``reach_deg`` off the axis; a loop."""
    angle, reach = _angles(frames), radians(reach_deg)
    light = _light(float(scene.light[0, :2].sum()), 0.6 * reach * angle.cos(), reach * angle.sin())
    return varied(scene, light=light)


def nodding_view(scene: Scene, frames: int = LOOP_FRAMES) -> Scene:
    """One scene while it rotates to either side and nods a little; a loop around the frontal view."""
    angle, camera = _angles(frames), torch.zeros(frames, 6)
    camera[:, 0] = radians(LOOP_VIEW_DEG) * 0.25 * (2 * angle).sin()
    camera[:, 1] = radians(LOOP_VIEW_DEG) * angle.sin()
    return varied(scene, camera=camera)


def swaying_view(scene: Scene, frames: int = LOOP_FRAMES, reach_deg: float = LOOP_VIEW_DEG) -> Scene:
    """One scene while it rotates to either side of its own view; a loop."""
    camera = scene.camera.repeat(frames, 1)
    camera[:, 1] += radians(reach_deg) * _angles(frames).sin().to(camera)
    return varied(scene, camera=camera)


def relit_and_rotated(scene: Scene, render: Render, frames: int = LOOP_FRAMES) -> Images:
    """The frames of both loops beside each other: the light goes round, the object rotates."""
    both = (drawn(loop(scene, frames), render) for loop in (circling_light, nodding_view))
    return [strip(list(pair)) for pair in zip(*both, strict=True)]


def _angles(frames: int) -> Float[Tensor, " k"]:
    """Once round in so many steps, in radians."""
    return 2 * pi * torch.arange(frames) / frames


def _light(strength: float, pitch: Tensor, yaw: Tensor) -> Float[Tensor, "k 4"]:
    ambient = torch.full_like(yaw, AMBIENT_SHARE * strength)
    return torch.stack((ambient, strength - ambient, pitch, yaw), dim=1)


def _around(t: Tensor, reach_deg: float, pitch_deg: float) -> tuple[Tensor, Tensor]:
    """Pitch and yaw in radians, from one side to the other."""
    check_angles(reach=reach_deg, pitch=pitch_deg)
    return torch.full_like(t, radians(pitch_deg)), radians(reach_deg) * (2 * t - 1)


def animated_png(frames: Images) -> bytes:
    """An endless loop as the bytes of an animated PNG."""
    # disposal=1: each frame starts from an empty canvas, since frames have transparent parts
    return _looping(frames, "PNG", round(2400 / len(frames)), disposal=1)


def gif(frames: Images, seconds: float = 2.4) -> bytes:
    """An endless loop as the bytes of a GIF on white; each frame has a palette of its own.

    A GIF counts in hundredths of a second, at least two for each frame.
    """
    flat = {id(frame): frame for frame in frames}  # on the way back frames come again
    for key, frame in flat.items():
        flat[key] = on_background(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG).copy()
    frame_ms = 10 * max(2, round(100 * seconds / len(frames)))
    return _looping([flat[id(frame)] for frame in frames], "GIF", frame_ms, optimize=False)


def _looping(frames: Images, form: str, frame_ms: int, **how: Any) -> bytes:
    first, *rest = frames
    return image_bytes(first, form, save_all=True, append_images=rest, duration=frame_ms, loop=0, **how)


def mp4(frames: Images, seconds: float = 2.4) -> bytes:
    """The frames once as the bytes of an H.264 film on white, for any player; odd sides gain a pixel.

    A computer without ffmpeg is an error that names the alternative.
    """
    width, height = frames[0].size
    odd = (0, 0, width % 2, height % 2)
    on_white = (np.asarray(ImageOps.expand(on_background(frame), odd, "white")) for frame in frames)
    even = (width + width % 2, height + height % 2)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        try:
            write_video(path, on_white, even, len(frames) / seconds)
        except ValueError as error:
            raise ValueError(f"{str(error).replace(str(path), 'MP4 here')}: write a GIF instead") from error
        return path.read_bytes()


FILMS = {"gif": gif, "mp4": mp4}
