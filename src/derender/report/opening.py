"""Opening images as the options of the image commands say: files become pixels and scenes.

The part of an image that suits the model is found: a face, by default. It is decomposed, optimised per image
on request, and drawn in its own detail unless that is declined. Leaves out edits (``editing``).
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from derender.data import as_float, is_image, read_photo
from derender.data.source import FolderSource
from derender.features import map_batches
from derender.model import Derenderer
from derender.photo import Frame, PhotoDetail, Photograph, editable_scenes, found_frame, is_video
from derender.render import Rendering
from derender.report.colours import depth_range
from derender.report.options import WHOLE_SIZE, ImageOptions
from derender.scene import Scene
from derender.scene.enlarge import at_size
from derender.storage.atomic import DamageNoticed
from derender.storage.places import model_folder
from derender.training import held_out_errors as errors
from derender.training.held_out_errors import HeldOutErrors

UNSUITABLE_PERCENTILE = 95.0
"""Up to it, and from ``LEAST_EXPLAINED`` on, images without a face are drawn: most generated heads are."""

T = TypeVar("T")
Read = tuple[np.ndarray, Frame, dict[str, Any], np.ndarray]
"""Pixels (3, S, S) at the model's size, the part of the file that they show, and that part as JSON has it.

Last the pixels by which the image is judged: no search by their error chose them."""


@dataclass(frozen=True)
class OpenedImage:
    """One decomposed image."""

    path: Path  # its file
    pixels: np.ndarray  # (3, S, S) uint8 at the model's size
    frame: Frame  # the part of the file that they show
    # the same as JSON has it: beside the middle square, in pixels, how it was ``found`` (``FoundFrame.how``),
    # and a ``doubt`` where it does not suit the model
    framing: Mapping[str, Any]
    scene: Scene  # one scene, on the model's device
    render: Callable[[Scene], Rendering]  # draws scenes like this one
    # of its reconstruction error among the held-out ones; None where the model keeps none. A part chosen by
    # that error has the middle square's.
    percentile: float | None
    depth_range: tuple[float, float]  # nearest and farthest depth of the images that were opened together

    @property
    def detail(self) -> PhotoDetail | None:
        """What draws the image's own pixels; None where the model's albedo is drawn."""
        drawing = self.render.detail if isinstance(self.render, Photograph) else self.render
        return drawing if isinstance(drawing, PhotoDetail) else None

    @property
    def shown(self) -> np.ndarray | Tensor:
        """(3, H, W) the image as it is drawn: its own pixels where these are, else the model's."""
        if isinstance(self.render, Photograph):
            return self.render.pixels.transpose(2, 0, 1)
        return self.pixels if self.detail is None else self.detail.photo


class ImageOpener:
    """Opens images with a model.

    Args:
        default_size: side of the output where ``options`` names none; never below the model's.
        default_detail: "photo" or "model", where ``options`` names none.
        whole: draw whole photographs, unless the options say otherwise.
        held_out: reconstruction errors that were stored with the model (``held_out_errors``).

    Raises:
        ValueError: the size is below the model's, or the model cannot optimise scenes per image.
    """

    def __init__(
        self, model: Derenderer, options: ImageOptions | None = None, *, default_size: int = 0,
        default_detail: str = "photo", whole: bool = False, held_out: HeldOutErrors | None = None,
    ):  # fmt: skip
        self.model, self.options, self.held_out = model, options or ImageOptions(), held_out
        self.size = self.options.size or max(default_size, model.image_size)
        self.detail = self.options.detail or default_detail
        self.whole = whole and self.detail == "photo" and not self.options.only_frame
        if self.size < model.image_size:
            raise ValueError(f"size {self.size} is below the model's: give --size {model.image_size} or more")

    def open(self, path: str | Path) -> OpenedImage:
        """One image with its scene as it is to be drawn."""
        path = Path(path)
        (image,) = self.decomposed({path: self.read(path)})
        return self.finer(image)

    def read(self, path: Path) -> Read:
        """Read a file; no image, or no face where one was asked for, is a ValueError or OSError."""
        photo = read_photo(path)
        frame, result, doubt = found_frame(photo, self.model, self.options.frame)
        middle = Frame.centred(photo.shape[1], photo.shape[0])
        place = {"x": frame.x, "y": frame.y, "side_px": frame.side, "roll_deg": frame.roll_deg}
        framing = {**frame.within(middle), **place, "found": result, **({"doubt": doubt} if doubt else {})}
        pixels = frame.cut(photo, self.model.image_size)
        judged = middle.cut(photo, self.model.image_size) if result == "auto" else pixels
        return pixels, frame, framing, judged

    def unsuitable(self, read: Mapping[Path, Read]) -> dict[Path, str]:
        """Images with a profile, and those without a face that the model reconstructs badly; the reasons."""
        doubts = {path: framing["doubt"] for path, (_, _, framing, _) in read.items() if "doubt" in framing}
        faceless = [path for path in doubts if read[path][2]["found"] != "profile"]
        if faceless and self.held_out is not None:
            judged = np.stack([read[path][-1] for path in faceless])
            percentiles = errors.reconstruction_percentile(self.model, judged, self.held_out)
            shares = errors.explained_variance(self.model, judged)
            for path, worse, share in zip(faceless, percentiles, shares, strict=True):
                doubts[path] += f"; reconstructed worse than {worse:.0f} % of the validation images"
                doubts[path] += f", with {100 * max(0, share):.0f} % of its variance explained"
                if worse <= UNSUITABLE_PERCENTILE and share >= errors.LEAST_EXPLAINED:
                    del doubts[path]
        return doubts

    def decomposed(self, read: Mapping[Path, Read]) -> list[OpenedImage]:
        """Every image with its scene, feed-forward or optimised, at the model's size."""
        steps, stacked = self.options.fit_steps, np.stack([pixels for pixels, *_ in read.values()])
        if steps is None and not self.whole:
            steps = 0
        scenes_of = partial(editable_scenes, self.model, steps=steps)
        batches = map_batches(scenes_of, self.model, stacked, batch_size=self.options.batch_size)
        scenes = [batch[row].detach() for batch in batches for row in range(len(batch))]
        limits = depth_range(torch.cat([scene.depth.cpu() for scene in scenes]))
        percentiles: Sequence[float | None] = [None] * len(scenes)
        if self.held_out is not None:
            judged = np.stack([middle for _, _, _, middle in read.values()])
            percentiles = errors.reconstruction_percentile(self.model, judged, self.held_out).tolist()
        rows = zip(read.items(), scenes, percentiles, strict=True)
        return [
            OpenedImage(path, pixels, frame, framing, scene, self.model.render, percentile, limits)
            for (path, (pixels, frame, framing, _)), scene, percentile in rows
        ]

    def finer(self, image: OpenedImage) -> OpenedImage:
        """The image as it is drawn: its scene at the output's size or, unless declined, its own pixels."""
        if self.detail == "model":
            return replace(image, scene=at_size(image.scene, self.size))
        photo = read_photo(image.path)
        if self.whole and image.frame.side < max(photo.shape[:2]):
            drawing = Photograph.of(photo, image.frame, image.scene, self.model)
            return replace(image, render=drawing.at_most(self.options.size or WHOLE_SIZE))
        pixels = as_float(image.frame.cut(photo, self.size)[None])[0]
        detail = PhotoDetail(pixels, image.scene, self.model.fov_deg, renderer=self.model.renderer)
        return replace(image, render=detail)


def image_files(paths: Sequence[Path], out: Path) -> list[Path]:
    """The files that were named, once each, and of folders the images and videos that are not in ``out``."""
    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        if path.resolve() == out.resolve():
            raise ValueError(f"{out} is the folder of the images: choose another --out, as {out / 'out'}")
        source = FolderSource(path)
        wanted = [source.on_disk(f) for f in source.files if is_image(f) or is_video(Path(f))]
        if out.resolve().is_relative_to(path.resolve()):
            wanted = [file for file in wanted if not file.resolve().is_relative_to(out.resolve())]
        if not wanted:
            raise ValueError(f"{path} holds no images")
        files += wanted
    return list(dict.fromkeys(files))


def readable(
    paths: Sequence[Path], read: Callable[[Path], T], progress: Callable[..., object] | None = None,
    needed: bool = True,
) -> tuple[dict[Path, T], dict[Path, str]]:  # fmt: skip
    """Every file that can be read, and why the others cannot; none is an error where one is ``needed``."""
    result: dict[Path, T] = {}
    refused: dict[Path, str] = {}
    for number, path in enumerate(paths):
        if progress is not None:
            progress(number, len(paths), description="reading")
        try:
            result[path] = read(path)
        except (ValueError, OSError) as problem:
            refused[path] = " ".join(str(problem).split())
    if needed and refused and not result:
        raise ValueError(next(iter(refused.values())))
    return result, refused


def held_out_errors(source: str | Path) -> HeldOutErrors | None:
    """The reconstruction errors stored with a model; None, with a warning, where they are damaged."""
    try:
        return errors.read_errors(model_folder(source))
    except (ValueError, OSError) as problem:
        warnings.warn(f"cannot find out-of-distribution images: {problem}", DamageNoticed, stacklevel=2)
        return None
