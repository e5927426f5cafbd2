"""A video in, a video out: every frame edited as a photograph, with parameters that are smooth over time.

Three passes over the video, so that memory grows with the model's small scenes and not with the frames: the
part that suits the model is found (by the face nearest to the last one), the frames are decomposed, edited
frames are drawn. Places, depth, albedo, light and camera are smoothed by a Gaussian over time. OpenCV reads,
the ffmpeg of imageio-ffmpeg writes. Leaves out several faces.
"""

import os
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from derender.model import Derenderer
from derender.photo.edit import Photograph, editable_scenes, found_frame
from derender.photo.faces import UTKFACE, find_faces, frame_of, template_of
from derender.photo.frame import Frame, Pixels
from derender.scene import Scene
from derender.storage.atomic import atomic_file
from derender.storage.places import require_known

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi")
SEARCH_EVERY_SECONDS = 0.2  # time between frames searched for the face; in between it is interpolated
SMOOTH_SECONDS = {"place": 0.15, "depth": 0.5, "albedo": 0.5, "light": 0.3, "camera": 0.1}
"""Standard deviation of the Gaussian over time."""
LONGEST_FRAMES = 18_000
BATCH = 64

Edit = Callable[[Scene], Mapping[str, Tensor]]  # all frames' scenes to parameters, a row each, in their place


@dataclass(frozen=True)
class EditedVideo:
    """What `edit_video` wrote: number, size and rate of its frames."""

    out: Path
    frames: int
    width: int
    height: int
    fps: float
    searched: int  # frames in which a face was looked for
    found: int  # and in which it was found


def edit_video(
    video: str | Path, out: str | Path, model: Derenderer, edit: Edit, *, frame: str | None = None,
    fit_steps: int | None = None, progress: Callable[..., object] | None = None,
) -> EditedVideo:  # fmt: skip
    """Edit every frame of a video, and write it as MP4 with its sound.

    Args:
        edit: gives new parameters for the scenes of all frames.
        fit_steps: as `editable_scenes` takes them.
        frame: "face", the default of models of faces, or "none", the middle square.
        progress: called with (frames done, frames in all) and what is being done as ``description``.

    Raises:
        ValueError: no video, one that is too long, another ``frame``, or none of its frames shows a face.
    """
    video, out, report = Path(video), Path(out), progress or (lambda *_, **__: None)
    require_known("frame of a video", frame or "none", ("face", "none"))
    reader = _opened(video)
    fps, total = reader.get(cv2.CAP_PROP_FPS), int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    reader.release()
    faces = frame == "face" or (frame is None and template_of(model) is not None)
    every = max(1, round(SEARCH_EVERY_SECONDS * fps))
    places: dict[int, Frame] = {}
    count, pixels = 0, np.empty((0, 0, 3), np.uint8)
    for count, pixels in enumerate(_frames(video), 1):
        if count > LONGEST_FRAMES:
            raise ValueError(f"{video} has more than {LONGEST_FRAMES:,} frames: cut it into parts")
        if not faces:
            places[0] = found_frame(pixels, model, "none").frame
        elif (count - 1) % every == 0 and (place := _tracked(pixels, model, places)) is not None:
            places[count - 1] = place
        report(count, max(count, total), description="finding faces")
    if not places:
        raise ValueError(f"no face is found in {video}: choose frame none")
    frames, (height, width) = _smooth_places(places, count, fps), pixels.shape[:2]
    scenes, cuts = [], []
    for number, pixels in enumerate(_frames(video)):
        cuts.append(frames[number].cut(pixels, model.image_size))
        if len(cuts) == BATCH or number == count - 1:
            images = torch.from_numpy(np.stack(cuts)).to(model.device).float() / 255
            scenes.append(editable_scenes(model, images, fit_steps).detach())
            cuts = []
        report(number + 1, count, description="decomposing")
    scene = _smooth(Scene.joined(scenes), fps)
    edited = scene.with_parameters(**edit(scene))

    def drawn() -> Iterator[Pixels]:
        for number, pixels in enumerate(_frames(video)):
            photo = Photograph.of(pixels, frames[number], scene[number], model)
            result = photo.edited(**edited[number].parameters)
            report(number + 1, count, description="drawing")
            yield result

    write_video(out, drawn(), (width, height), fps, video)
    searched = len(range(0, count, every)) if faces else 0
    return EditedVideo(out, count, width, height, fps, searched, len(places) if faces else 0)


def is_video(path: Path) -> bool:
    """Whether the name has a video's suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def write_video(
    out: Path, frames: Iterator[Pixels], size: tuple[int, int], fps: float, sound: Path | None = None
) -> None:
    """Frames as H.264 in MP4, odd sides less a pixel, with the sound of another file, if it has any."""
    from imageio_ffmpeg import get_ffmpeg_exe, write_frames

    width, height = size[0] // 2 * 2, size[1] // 2 * 2
    rate: Any = fps  # ffmpeg takes any number
    with TemporaryDirectory() as folder, atomic_file(out) as temporary:
        silent = str(Path(folder) / "silent.mp4")
        try:
            writer = write_frames(
                silent, (width, height), fps=rate, codec="libx264", quality=8, macro_block_size=2,
                ffmpeg_log_level="error",
            )  # fmt: skip
            writer.send(None)
            for pixels in frames:
                writer.send(np.ascontiguousarray(pixels[:height, :width]))
            writer.close()
            sounds = [] if sound is None else ["-i", str(sound), "-map", "0:v", "-map", "1:a?", "-c:a", "aac"]
            words = ["-i", silent, *sounds, "-c:v", "copy", "-movflags", "+faststart", "-f", "mp4", "-y"]
            words = [get_ffmpeg_exe(), "-nostdin", "-loglevel", "error", *words, str(temporary)]
            subprocess.run(words, check=True, capture_output=True)
        except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
            raise ValueError(f"ffmpeg cannot write {out}: {str(error).splitlines()[0]}") from error


def _opened(video: Path) -> Any:
    """OpenCV's reader; what is no video is a ValueError."""
    if not video.is_file():
        raise FileNotFoundError(f"{video} does not exist")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # a damaged file is named once, by us
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    reader = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    if not reader.isOpened() or reader.get(cv2.CAP_PROP_FPS) <= 0:
        raise ValueError(f"{video} cannot be read as a video")
    return reader


def _frames(video: Path) -> Iterator[Pixels]:
    reader = _opened(video)
    try:
        while (read := reader.read())[0]:
            yield np.ascontiguousarray(read[1][..., ::-1])
    finally:
        reader.release()


def _tracked(pixels: np.ndarray, model: Derenderer, places: Mapping[int, Frame]) -> Frame | None:
    """The frame of the face nearest to the last one, of the largest at first; None where there is none."""
    results = [frame_of(face, template_of(model) or UTKFACE) for face in find_faces(pixels)]
    if not results or not places:
        return results[0] if results else None
    last = places[max(places)]
    nearest = min(results, key=lambda one: np.hypot(one.x - last.x, one.y - last.y))
    return nearest if np.hypot(nearest.x - last.x, nearest.y - last.y) < 1.5 * last.side else None


def _smooth_places(places: Mapping[int, Frame], count: int, fps: float) -> list[Frame]:
    """A frame for each of the video's, interpolated and smoothed."""
    at = sorted(places)
    numbers = np.array([[places[k].x, places[k].y, places[k].side, places[k].roll_deg] for k in at])
    numbers[:, 3] = np.degrees(np.unwrap(np.radians(numbers[:, 3])))
    every = np.stack([np.interp(np.arange(count), at, column) for column in numbers.T], axis=1)
    return [Frame(*row) for row in _over_time(every, SMOOTH_SECONDS["place"] * fps).tolist()]


def _over_time(values: np.ndarray, frames: float) -> np.ndarray:
    """Rows smoothed by a Gaussian of so many frames."""
    from scipy.ndimage import gaussian_filter1d  # a tenth of a second

    return np.asarray(gaussian_filter1d(values, frames, axis=0, mode="nearest"))


def _smooth(scene: Scene, fps: float) -> Scene:
    """The scenes of consecutive frames, each parameter smoothed over time."""
    smoothed = {}
    for name, values in scene.parameters.items():
        frames = SMOOTH_SECONDS.get(name, SMOOTH_SECONDS["albedo"]) * fps
        smoothed[name] = torch.from_numpy(_over_time(values.cpu().numpy(), frames)).to(values)
    return scene.with_parameters(**smoothed)
