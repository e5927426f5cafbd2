"""Films as bytes: animated PNG (all colours, transparency), GIF (256 colours a frame), MP4 (H.264).

Leaves out the frames (``sweeps``).
"""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from derender.photo.video import write_video
from derender.report.colours import Images, on_background


def animated_png(frames: Images, seconds: float = 2.4) -> bytes:
    """An endless loop as the bytes of an animated PNG."""
    # disposal=1: each frame starts from an empty canvas, since frames have transparent parts
    return _animated(frames, "PNG", round(1000 * seconds / max(1, len(frames))), disposal=1)


def gif(frames: Images, seconds: float = 2.4) -> bytes:
    """An endless loop as the bytes of a GIF on white; each frame has a palette of its own.

    A GIF counts in hundredths of a second, at least two for each frame.
    """
    flat = {
        id(frame): on_background(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG).copy()
        for frame in {id(frame): frame for frame in frames}.values()
    }
    return _animated(
        [flat[id(frame)] for frame in frames],
        "GIF",
        10 * max(2, round(100 * seconds / max(1, len(frames)))),
        optimize=False,
    )


def _animated(frames: Images, form: str, frame_ms: int, **settings: Any) -> bytes:
    _enough(frames)
    stream = BytesIO()
    first, *rest = frames
    first.save(stream, format=form, save_all=True, append_images=rest, duration=frame_ms, loop=0, **settings)
    return stream.getvalue()


def mp4(frames: Images, seconds: float = 2.4) -> bytes:
    """The frames once as the bytes of an H.264 film on white, for any player; odd sides gain a pixel.

    A computer without ffmpeg is an error that names the alternative.
    """
    _enough(frames)
    width, height = frames[0].size
    even = (width + width % 2, height + height % 2)

    def on_white() -> Iterator[np.ndarray]:
        for frame in frames:
            canvas = Image.new("RGB", even, (255, 255, 255))
            canvas.paste(on_background(frame), (0, 0))
            yield np.asarray(canvas)

    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        try:
            write_video(path, on_white(), even, len(frames) / seconds)
        except ValueError as error:
            raise ValueError(f"{str(error).replace(str(path), 'MP4 here')}: write a GIF instead") from error
        return path.read_bytes()


FILMS = {"gif": gif, "mp4": mp4}


def _enough(frames: Images) -> None:
    if len(frames) < 2:
        raise ValueError(f"a film needs at least two frames; got {len(frames)}")
