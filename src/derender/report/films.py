"""Short loops of one picture: the light going round it, the object turning.

Gives frames and animated PNG bytes (all colours, transparency; GIF has 256 colours). Leaves out MP4.
"""

from collections.abc import Callable
from io import BytesIO
from math import cos, pi, radians, sin

import torch
from PIL import Image

from derender.render import Rendering
from derender.report.colours import Images, pictures
from derender.scene import Scene


def relighting(
    scene: Scene, render: Callable[[Scene], Rendering], frames: int = 24, reach_deg: float = 45
) -> Images:
    """One scene while its light goes round once, ``reach_deg`` off the axis; a loop."""
    repeated = _repeated(scene, frames)
    light = repeated.light.clone()
    light[:, 0], light[:, 1] = 0.35, 0.65
    for frame in range(frames):
        angle = 2 * pi * frame / frames
        light[frame, 2] = radians(reach_deg) * 0.6 * cos(angle)
        light[frame, 3] = radians(reach_deg) * sin(angle)
    return _rendered(repeated.with_parameters(light=light), render)


def rotation(
    scene: Scene, render: Callable[[Scene], Rendering], frames: int = 24, reach_deg: float = 35
) -> Images:
    """One scene while it turns to either side and nods a little; a loop around the frontal view."""
    repeated = _repeated(scene, frames)
    camera = torch.zeros_like(repeated.camera)
    for frame in range(frames):
        angle = 2 * pi * frame / frames
        camera[frame, 0] = radians(reach_deg) * 0.25 * sin(2 * angle)
        camera[frame, 1] = radians(reach_deg) * sin(angle)
    return _rendered(repeated.with_parameters(camera=camera), render)


def animated_png(frames: Images, seconds: float = 2.4) -> bytes:
    """An endless loop as the bytes of an animated PNG."""
    if len(frames) < 2:
        raise ValueError(f"a film needs at least two frames; got {len(frames)}")
    stream = BytesIO()
    first, *rest = frames
    duration_ms = round(1000 * seconds / len(frames))
    first.save(
        stream,
        format="PNG",
        save_all=True,
        append_images=rest,
        duration=duration_ms,
        loop=0,
        disposal=1,  # each frame starts from an empty canvas: frames have transparent parts
    )
    return stream.getvalue()


def side_by_side(films: list[Images]) -> Images:
    """Films of equal length as one film, next to each other."""
    lengths = {len(film) for film in films}
    if len(lengths) != 1:
        raise ValueError(f"films next to each other need the same number of frames; got {sorted(lengths)}")
    joined = []
    for row in zip(*films, strict=True):
        canvas = Image.new("RGBA", (sum(image.width for image in row), row[0].height), (0, 0, 0, 0))
        x = 0
        for image in row:
            canvas.paste(image, (x, 0))
            x += image.width
        joined.append(canvas)
    return joined


def _repeated(scene: Scene, frames: int) -> Scene:
    if len(scene) != 1:
        raise ValueError(f"a film shows one scene; got {len(scene)}: pass scene[index]")
    return scene.detach().map(lambda value: value.expand(frames, *value.shape[1:]).clone())


def _rendered(scene: Scene, render: Callable[[Scene], Rendering]) -> Images:
    with torch.no_grad():
        rendering = render(scene)
    return pictures(rendering.image, rendering.mask)
