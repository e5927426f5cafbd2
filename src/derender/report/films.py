"""Short loops of one picture: the light going round it, the object turning.

Gives frames, and films as bytes: animated PNG (all colours, transparency), GIF (256 colours a frame), MP4
(H.264, through the ffmpeg that imageio-ffmpeg brings). Leaves out sweeps of one's own (see ``sweeps``).
"""

from collections.abc import Callable
from io import BytesIO
from math import cos, pi, radians, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

from derender.render import Rendering
from derender.report.colours import Images, on_background, pictures
from derender.report.sweeps import AMBIENT_SHARE
from derender.scene import Scene


def relighting(
    scene: Scene, render: Callable[[Scene], Rendering], frames: int = 24, reach_deg: float = 45
) -> Images:
    """One scene while a light as strong as its own goes round once, ``reach_deg`` off the axis; a loop."""
    repeated = _repeated(scene, frames)
    light = repeated.light.clone()
    strength = light[:, 0] + light[:, 1]
    light[:, 0], light[:, 1] = AMBIENT_SHARE * strength, (1 - AMBIENT_SHARE) * strength
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
    _enough(frames)
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


def gif(frames: Images, seconds: float = 2.4) -> bytes:
    """An endless loop as the bytes of a GIF on white; each frame has a palette of its own.

    A GIF counts in hundredths of a second, at least two for each frame.
    """
    _enough(frames)
    stream = BytesIO()
    flat = [on_background(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG).copy() for frame in frames]
    duration_ms = 10 * max(2, round(100 * seconds / len(frames)))
    first, *rest = flat
    first.save(
        stream, format="GIF", save_all=True, append_images=rest, duration=duration_ms, loop=0, optimize=False
    )
    return stream.getvalue()


def mp4(frames: Images, seconds: float = 2.4, quality: int = 8) -> bytes:
    """The frames once as the bytes of an H.264 film on white, for any player; odd sides gain a pixel.

    ``quality`` runs from 0 to 10. A computer without ffmpeg is an error that says what to do.
    """
    _enough(frames)
    from imageio_ffmpeg import write_frames

    width, height = frames[0].size
    rate: Any = len(frames) / seconds  # ffmpeg takes any number, imageio-ffmpeg's hint says int
    even = (width + width % 2, height + height % 2)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        try:
            writer = write_frames(
                str(path), even, fps=rate, codec="libx264", quality=quality,
                macro_block_size=2, ffmpeg_log_level="error",
            )  # fmt: skip
            writer.send(None)
            for frame in frames:
                canvas = Image.new("RGB", even, (255, 255, 255))
                canvas.paste(on_background(frame), (0, 0))
                writer.send(np.ascontiguousarray(canvas))
            writer.close()
        except (OSError, RuntimeError) as error:
            raise ValueError(
                f"ffmpeg cannot write MP4 here ({str(error).splitlines()[0]}): write a GIF instead"
            ) from error
        return path.read_bytes()


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


def _enough(frames: Images) -> None:
    if len(frames) < 2:
        raise ValueError(f"a film needs at least two frames; got {len(frames)}")


def _repeated(scene: Scene, frames: int) -> Scene:
    if len(scene) != 1:
        raise ValueError(f"a film shows one scene; got {len(scene)}: pass scene[index]")
    return scene.detach().map(lambda value: value.expand(frames, *value.shape[1:]).clone())


def _rendered(scene: Scene, render: Callable[[Scene], Rendering]) -> Images:
    with torch.no_grad():
        rendering = render(scene)
    return pictures(rendering.image, rendering.mask)
