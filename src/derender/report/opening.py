"""Options of the image commands, and opening images by them: files become pixels and scenes.

The part of an image that suits the model is found: a face, by default. It is decomposed, optimised per image
on request, and drawn in its own detail unless that is declined. Each field of ``ImageOptions`` is an option
of every image command (``cli/gathered.py``): a new one is a field here and its use in ``ImageOpener``. Heavy
packages are imported where they are used: the command line imports this module for its help. Leaves out edits
(``editing``).
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from derender.storage.places import require_known

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from derender.model import Derenderer
    from derender.photo import Frame, PhotoDetail
    from derender.render import Rendering
    from derender.scene import Scene
    from derender.training.held_out_errors import HeldOutErrors

T = TypeVar("T")
CHOICES = {"detail": ("photo", "model"), "frame": ("face", "auto", "none")}
OLD_TEXTURES = {"original": "photo", "model": "model"}
OLD_CROPS = {"whole": "none", "auto": "auto"}
FILM_KINDS, MESH_FORMATS = ("gif", "mp4"), ("glb", "obj")
EDIT_SIZE, WHOLE_SIZE, MESH_SIZE, TEXTURE_SIZE = 384, 1024, 128, 1024
"""Default sides in pixels: of edits, of whole photographs at most, of a mesh's grid and texture."""


def option(default: Any, help: str, **shown: Any) -> Any:
    """A field that the command line makes an option of; ``shown`` are further words of typer (``min``)."""
    return field(default=default, metadata={"help": help, **shown})


@dataclass(frozen=True)
class ImageOptions:
    """How an image is read and its scene drawn."""

    size: int | None = option(
        None,
        "Side of the output: 384, of whole photographs and textures of meshes at most 1,024, of "
        "decompositions the model's.",
        min=8,
        max=4096,
    )
    detail: str | None = option(
        None,
        "photo: the image's own pixels. model: the model's albedo. Decompositions default to model.",
        metavar="photo|model",
    )
    texture: str | None = option(None, "Old spelling of detail.", hidden=True)
    fit_steps: int | None = option(
        None, "Optimise each scene against its image in N steps (60, say; slow).", min=0, max=10_000
    )
    frame: str | None = option(
        None,
        "face: the largest face. auto: the part that the model reconstructs best. none: the middle square. "
        "By default face for models of faces, else none.",
        metavar="face|auto|none",
    )
    crop: str | None = option(None, "Old spelling of frame: whole or auto.", hidden=True)
    only_frame: bool = option(False, "Draw the frame only, not the whole photograph around it.")
    batch_size: int = option(64, "Images per batch; changes speed and memory only.", min=1, metavar="N")

    def __post_init__(self) -> None:
        for old, name, known in (("texture", "detail", OLD_TEXTURES), ("crop", "frame", OLD_CROPS)):
            if (value := getattr(self, old)) is not None:
                require_known(old, value, tuple(known))
                object.__setattr__(self, name, known[value])
        object.__setattr__(self, "frame", OLD_CROPS.get(self.frame or "", self.frame))
        for name, known in CHOICES.items():
            if (value := getattr(self, name)) is not None:
                require_known(name, value, known)


@dataclass(frozen=True)
class FilmOptions:
    """What a sweep is drawn as: a strip of stills and a film that goes there and back."""

    stills: int = option(7, "Number of images in the strip.", min=2, max=64, metavar="N")
    film: str = option(
        "gif,mp4", "Kinds of film: gif, mp4, both with a comma between, or none.", metavar="KINDS"
    )
    frames: int = option(48, "Number of frames of the film.", min=2, max=1000, metavar="N")
    hold: bool = option(False, "Hold a video's light or view at --reach, instead of going there and back.")
    seconds: float = option(4.0, "Length of the film in seconds.", min=0.1, max=60)

    def __post_init__(self) -> None:
        for kind in self.kinds:
            require_known("kind of film", kind, (*FILM_KINDS, "none"))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of film by name; none for "none"."""
        kinds = tuple(dict.fromkeys(kind.strip().lower() for kind in self.film.split(",")))
        return () if kinds == ("none",) else kinds


@dataclass(frozen=True)
class OpenedImage:
    """One decomposed image."""

    path: Path  # its file
    pixels: "np.ndarray"  # (3, S, S) uint8 at the model's size
    frame: "Frame"  # the part of the file that they show
    # the same as JSON has it: beside the middle square, in pixels, and how it was found ("face", "auto",
    # "none", or "no face" where one was looked for in vain)
    framing: Mapping[str, Any]
    scene: "Scene"  # one scene, on the model's device
    render: "Callable[[Scene], Rendering]"  # draws scenes like this one
    # of its reconstruction error among the held-out ones; None where the model keeps none. A part chosen by
    # that error has the middle square's.
    percentile: float | None
    depth_range: tuple[float, float]  # nearest and farthest depth of the images that were opened together

    @property
    def detail(self) -> "PhotoDetail | None":
        """What draws the image's own pixels; None where the model's albedo is drawn."""
        from derender.photo import PhotoDetail, Photograph

        drawing = self.render.detail if isinstance(self.render, Photograph) else self.render
        return drawing if isinstance(drawing, PhotoDetail) else None

    @property
    def shown(self) -> "np.ndarray | Tensor":
        """(3, H, W) the image as it is drawn: its own pixels where these are, else the model's."""
        from derender.photo import Photograph

        if isinstance(self.render, Photograph):
            return self.render.pixels.transpose(2, 0, 1)
        return self.pixels if self.detail is None else self.detail.photo

    @property
    def side(self) -> int:
        """Of a square drawing of its scene, in pixels: as ``shown``, of whole photographs 384."""
        size = self.shown.shape
        return size[-1] if size[-1] == size[-2] else EDIT_SIZE

    @property
    def textured(self) -> "Scene":
        """The scene as it is drawn, at that size, with the image's own texture where that is drawn."""
        from derender.scene.enlarge import at_size

        if (detail := self.detail) is None:
            return self.scene
        scene = at_size(self.scene, detail.size)
        return scene.with_parameters(albedo=detail.on_grid(detail.albedo(), detail.size))


class ImageOpener:
    """Opens images with a model.

    Args:
        model: trained.
        options: how images are read and drawn.
        default_size: side of the output where ``options`` names none; never below the model's.
        default_detail: "photo" or "model", where ``options`` names none.
        whole: draw whole photographs, unless the options say otherwise.
        held_out: reconstruction errors that were stored with the model (``held_out_errors``).

    Raises:
        ValueError: the size is below the model's, or the model cannot optimise scenes per image.
    """

    def __init__(
        self,
        model: "Derenderer",
        options: ImageOptions | None = None,
        *,
        default_size: int = 0,
        default_detail: str = "photo",
        whole: bool = False,
        held_out: "HeldOutErrors | None" = None,
    ):
        self.model, self.options, self.held_out = model, options or ImageOptions(), held_out
        self.size = self.options.size or max(default_size, model.image_size)
        self.detail = self.options.detail or default_detail
        self.whole = whole and self.detail == "photo" and not self.options.only_frame
        if self.size < model.image_size:
            raise ValueError(f"size {self.size} is below the model's {model.image_size}: give that or more")

    def open(self, path: str | Path) -> OpenedImage:
        """One image with its scene as it is to be drawn."""
        path = Path(path)
        (image,) = self.decomposed({path: self.read(path)})
        return self.finer(image)

    def read(self, path: Path) -> "tuple[np.ndarray, Frame, dict[str, Any], np.ndarray]":
        """Pixels at the model's size, the part of the file that they show, the same as JSON has it.

        At last the pixels by which the image is judged, which no search by their error chose.
        A file that is no image, or shows no face where one was asked for, is a ValueError or OSError.
        """
        from derender.data import read_photo
        from derender.photo import Frame, found_frame

        photo = read_photo(path)
        frame, found = found_frame(photo, self.model, self.options.frame)
        middle = Frame.centred(photo.shape[1], photo.shape[0])
        place = {"x": frame.x, "y": frame.y, "side_px": frame.side, "roll_deg": frame.roll_deg}
        framing = {**frame.within(middle), **place, "found": found}
        pixels = frame.cut(photo, self.model.image_size)
        judged = middle.cut(photo, self.model.image_size) if found == "auto" else pixels
        return pixels, frame, framing, judged

    def decomposed(
        self, read: "Mapping[Path, tuple[np.ndarray, Frame, Mapping[str, Any], np.ndarray]]"
    ) -> list[OpenedImage]:
        """Every image with its scene, feed-forward or optimised, at the model's size."""
        import numpy as np
        import torch

        from derender.features import map_batches
        from derender.report.colours import depth_range
        from derender.training.held_out_errors import reconstruction_percentile

        steps, stacked = self.options.fit_steps, np.stack([pixels for pixels, *_ in read.values()])

        def scenes_of(images: "Tensor") -> "Scene":
            return self.model.fit_scenes(images, steps).scene if steps else self.model.decompose(images)

        batches = map_batches(scenes_of, self.model, stacked, batch_size=self.options.batch_size)
        scenes = [batch[row].detach() for batch in batches for row in range(len(batch))]
        limits = depth_range(torch.cat([scene.depth.cpu() for scene in scenes]))
        percentiles: Sequence[float | None] = [None] * len(scenes)
        if self.held_out is not None:
            judged = np.stack([middle for _, _, _, middle in read.values()])
            percentiles = reconstruction_percentile(self.model, judged, self.held_out).tolist()
        rows = zip(read.items(), scenes, percentiles, strict=True)
        return [
            OpenedImage(path, pixels, frame, framing, scene, self.model.render, percentile, limits)
            for (path, (pixels, frame, framing, _)), scene, percentile in rows
        ]

    def finer(self, image: OpenedImage) -> OpenedImage:
        """The image as it is drawn: its scene at the output's size or, unless declined, its own pixels."""
        from derender.data import as_float, read_photo
        from derender.photo import PhotoDetail, Photograph
        from derender.scene.enlarge import at_size

        if self.detail == "model":
            return replace(image, scene=at_size(image.scene, self.size))
        photo = read_photo(image.path)
        if self.whole and image.frame.side < max(photo.shape[:2]):
            drawing = Photograph.of(photo, image.frame, image.scene, self.model)
            return replace(image, render=drawing.at_most(self.options.size or WHOLE_SIZE))
        pixels = as_float(image.frame.cut(photo, self.size)[None])[0]
        detail = PhotoDetail(pixels, image.scene, self.model.fov_deg, renderer=self.model.renderer)
        return replace(image, render=detail)


def image_files(paths: Sequence[Path]) -> list[Path]:
    """The files that were named, and in place of a folder the images and videos in it, once each."""
    from derender.data import is_image
    from derender.data.source import FolderSource
    from derender.photo import is_video

    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        source = FolderSource(path)
        wanted = [source.on_disk(f) for f in source.files if is_image(f) or is_video(Path(f))]
        if not wanted:
            raise ValueError(f"{path} holds no images")
        files += wanted
    return list(dict.fromkeys(files))


def readable(
    paths: Sequence[Path], read: Callable[[Path], T], progress: Callable[..., object] | None = None
) -> tuple[dict[Path, T], dict[str, str]]:
    """Every file that can be read, and reasons why the others cannot; none at all is an error."""
    found: dict[Path, T] = {}
    refused: dict[str, str] = {}
    for number, path in enumerate(paths):
        if progress is not None:
            progress(number, len(paths), description="reading")
        try:
            found[path] = read(path)
        except (ValueError, OSError) as problem:
            refused[str(path)] = " ".join(str(problem).split())
    if refused and not found:
        raise ValueError(next(iter(refused.values())))
    return found, refused


def held_out_errors(source: str | Path) -> "HeldOutErrors | None":
    """The reconstruction errors stored with a model; None, with a warning, where they are damaged."""
    from derender.storage.atomic import DamageNoticed
    from derender.storage.places import model_folder
    from derender.training.held_out_errors import read_errors

    try:
        return read_errors(model_folder(source))
    except (ValueError, OSError) as problem:
        warnings.warn(f"cannot find out-of-distribution images: {problem}", DamageNoticed, stacklevel=2)
        return None
