"""Options of the image commands, and opening images by them: files become pixels and scenes.

An image is read (cropped on request), decomposed, optimised per image on request, enlarged, and given its own
texture unless that is declined. Each field of ``ImageOptions`` is an option of every image command
(``cli/gathered.py``): a new one is a field here and its use in ``ImageOpener``. Heavy packages are imported
where they are used: the command line imports this module for its help. Leaves out edits and writing
(``editing``).
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from derender.model import Derenderer
    from derender.scene import Scene
    from derender.scene.crop_search import Crop
    from derender.training.held_out_errors import HeldOutErrors

T = TypeVar("T")
CHOICES = {"detail": ("photo", "model"), "crop": ("whole", "auto")}
OLD_TEXTURES = {"original": "photo", "model": "model"}
FILM_KINDS = ("gif", "mp4")
EDIT_SIZE, MESH_SIZE = 256, 128
"""Default sides of the output in pixels; decompositions have the model's own."""


def option(default: Any, help: str, **shown: Any) -> Any:
    """A field that the command line makes an option of; ``shown`` are further words of typer (``min``)."""
    return field(default=default, metadata={"help": help, **shown})


@dataclass(frozen=True)
class ImageOptions:
    """How an image is read and its scene drawn."""

    size: int | None = option(
        None, "Side of the output: 256, of meshes 128, of decompositions the model's.", min=8, max=4096
    )
    detail: str | None = option(
        None,
        "photo: texture from the image itself. model: the model's albedo. Decompositions default to model.",
        metavar="photo|model",
    )
    texture: str | None = option(None, "Old spelling of detail.", hidden=True)
    fit_steps: int | None = option(
        None, "Optimise each scene against its image in N steps (60, say; slow).", min=0, max=10_000
    )
    crop: str = option(
        "whole", "auto: the part of each image that the model reconstructs best.", metavar="whole|auto"
    )
    frame: str | None = option(None, "Old spelling of crop.", hidden=True)
    batch_size: int = option(64, "Images per batch; changes speed and memory only.", min=1, metavar="N")

    def __post_init__(self) -> None:
        if self.frame is not None:
            object.__setattr__(self, "crop", self.frame)
        if self.texture is not None:
            _require_known("texture", self.texture, tuple(OLD_TEXTURES))
            object.__setattr__(self, "detail", OLD_TEXTURES[self.texture])
        for name, known in CHOICES.items():
            if (value := getattr(self, name)) is not None:
                _require_known(name, value, known)

    @property
    def cropped(self) -> bool:
        """Whether the part of each image is searched that the model reconstructs best."""
        return self.crop == "auto"


@dataclass(frozen=True)
class FilmOptions:
    """What a sweep is drawn as: a strip of stills and a film that goes there and back."""

    stills: int = option(7, "Number of images in the strip.", min=2, max=64, metavar="N")
    film: str = option(
        "gif,mp4", "Kinds of film: gif, mp4, both with a comma between, or none.", metavar="KINDS"
    )
    frames: int = option(48, "Number of frames of the film.", min=2, max=1000, metavar="N")
    seconds: float = option(4.0, "Length of the film in seconds.", min=0.1, max=60)

    def __post_init__(self) -> None:
        for kind in self.kinds:
            _require_known("kind of film", kind, (*FILM_KINDS, "none"))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of film by name; none for "none"."""
        kinds = tuple(dict.fromkeys(kind.strip().lower() for kind in self.film.split(",")))
        return () if kinds == ("none",) else kinds


def _require_known(what: str, word: str, known: Sequence[str]) -> None:
    """An unknown word is an error that suggests another."""
    if word not in known:
        from derender.data import suggestion

        raise ValueError(f"unknown {what} {word!r}{suggestion(word, known)}: choose {' or '.join(known)}")


@dataclass(frozen=True)
class OpenedImage:
    """One decomposed image.

    Attributes:
        path: its file.
        pixels: (3, S, S) uint8 at the model's size.
        crop: the part of the file that they show.
        scene: one scene, on the model's device.
        percentile: of its reconstruction error among the held-out ones; None where the model keeps none.
        depth_range: nearest and farthest depth of the images that were opened together.
    """

    path: Path
    pixels: "np.ndarray"
    crop: "Crop"
    scene: "Scene"
    percentile: float | None
    depth_range: tuple[float, float]


class ImageOpener:
    """Opens images with a model.

    Args:
        model: trained.
        options: how images are read and drawn.
        default_size: side of the output where ``options`` names none; never below the model's.
        default_detail: "photo" or "model", where ``options`` names none.
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
        held_out: "HeldOutErrors | None" = None,
    ):
        self.model, self.options, self.held_out = model, options or ImageOptions(), held_out
        self.size = self.options.size or max(default_size, model.image_size)
        self.detail = self.options.detail or default_detail
        if self.size < model.image_size:
            raise ValueError(f"size {self.size} is below the model's {model.image_size}: give that or more")

    def open(self, path: str | Path) -> OpenedImage:
        """One image with its scene as it is to be drawn."""
        path = Path(path)
        (image,) = self.decomposed({path: self.read(path)})
        return self.finer(image)

    def read(self, path: Path) -> "tuple[np.ndarray, Crop]":
        """Pixels at the model's size, and the part of the file that they show.

        A file that is no image is a ValueError or OSError that says so.
        """
        import torch

        from derender.scene.crop_search import SEARCH_SCALE, WHOLE, best_crops

        size, crop = self.model.image_size, WHOLE
        if self.options.cropped:
            (crop,) = best_crops(self.model, torch.from_numpy(read_file(path, SEARCH_SCALE * size)[None]))
        return read_crop(path, crop, size), crop

    def decomposed(self, read: "Mapping[Path, tuple[np.ndarray, Crop]]") -> list[OpenedImage]:
        """Every image with its scene, feed-forward or optimised, at the model's size."""
        import numpy as np
        import torch

        from derender.evaluation.out_of_distribution import reconstruction_percentile
        from derender.features import map_batches
        from derender.report.colours import depth_range

        steps, stacked = self.options.fit_steps, np.stack([pixels for pixels, _ in read.values()])

        def scenes_of(images: "Tensor") -> "Scene":
            return self.model.fit_scenes(images, steps).scene if steps else self.model.decompose(images)

        batches = map_batches(scenes_of, self.model, stacked, batch_size=self.options.batch_size)
        scenes = [batch[row].detach() for batch in batches for row in range(len(batch))]
        limits = depth_range(torch.cat([scene.depth.cpu() for scene in scenes]))
        percentiles: Sequence[float | None] = [None] * len(scenes)
        if self.held_out is not None:
            percentiles = reconstruction_percentile(self.model, stacked, self.held_out).tolist()
        rows = zip(read.items(), scenes, percentiles, strict=True)
        return [
            OpenedImage(path, pixels, crop, scene, percentile, limits)
            for (path, (pixels, crop)), scene, percentile in rows
        ]

    def finer(self, image: OpenedImage) -> OpenedImage:
        """The image with its scene at the output's size and, unless declined, its own texture."""
        from derender.data import as_float
        from derender.report.texture import picture_albedo, picture_on_grid
        from derender.scene.enlarge import at_size

        own, size = self.model.image_size, self.size
        scene = at_size(image.scene, size)
        if self.detail == "photo":
            pixels = as_float(read_crop(image.path, image.crop, size)[None]).to(scene.depth)
            if size != own:
                pixels = picture_on_grid(pixels, own)
            scene = scene.with_parameters(albedo=picture_albedo(pixels, scene, self.model.fov_deg))
        return replace(image, scene=scene)


def readable(paths: Sequence[Path], read: Callable[[Path], T]) -> tuple[dict[Path, T], dict[str, str]]:
    """Every file that can be read, and reasons why the others cannot; none at all is an error."""
    found: dict[Path, T] = {}
    refused: dict[str, str] = {}
    for path in dict.fromkeys(paths):
        try:
            found[path] = read(path)
        except (ValueError, OSError) as problem:
            refused[str(path)] = " ".join(str(problem).split())
    if refused and not found:
        raise ValueError(next(iter(refused.values())))
    return found, refused


def read_file(path: Path, size: int) -> "np.ndarray":
    """One image file, (3, size, size) uint8; a path that leads nowhere or to a folder is an error."""
    from derender.data import nearest_sibling, read_image

    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist{nearest_sibling(path)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name images, such as {path / '*.jpg'}")
    return read_image(path, size)


def read_crop(path: Path, crop: "Crop", size: int) -> "np.ndarray":
    """A part of an image file, (3, size, size) uint8."""
    import torch

    from derender.scene.crop_search import WHOLE, as_bytes

    if crop == WHOLE:
        return read_file(path, size)
    larger = torch.from_numpy(read_file(path, round(size / crop.side))[None])
    return as_bytes(crop.cut(larger, size))[0].numpy()


def held_out_errors(source: str | Path) -> "HeldOutErrors | None":
    """The reconstruction errors stored with a model; None, with a warning, where they are damaged."""
    from derender.storage.atomic import DamageNoticed
    from derender.storage.folder import model_folder
    from derender.training.held_out_errors import read_errors

    try:
        return read_errors(model_folder(source))
    except (ValueError, OSError) as problem:
        warnings.warn(f"cannot find out-of-distribution images: {problem}", DamageNoticed, stacklevel=2)
        return None
