"""Images of the page: opened ones, examples to begin with, and rows of a feature table by number.

Opened images are kept in memory only: a bounded number of them, and of bytes. Examples lie beside this file,
eight in a row. portraits.webp, for ``faces-64``: heads that ``derender.data.synthetic`` made (seed 7).
faces.png and heads.webp, for ``rendered-faces-64`` and ``rendered-faces-128``: eight of 800 images that each
was tested on, evenly spaced; cars.png: eight of the 1,000 that ``cars-64`` was tested on, evenly by class
(Kenney and Quaternius, CC0). Heads of faces.png: geometry ICT-FaceKit, MIT; skins MakeHuman, CC0; the others
are generated. They show no real person and no model saw them in training.
Rows of a table are read from folders, zips and tables of paths in place. A stream (tar shards, Hugging Face)
is read only from its beginning, so its images are not shown.
"""

import secrets
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from derender.data import ListedStream, open_images, parse_source
from derender.features import FeatureTable
from derender.photo import Frame
from derender.report.colours import image_bytes, pictures
from derender.report.page import data_uri
from derender.report.viewer.questions import Refused, pixels_of
from derender.scene import Scene

KEPT, KEPT_BYTES = 64, 400_000_000  # opened images, and bytes of their photographs together
ROWS = {
    **dict.fromkeys(("faces-64", "faces-128"), "portraits.webp"),
    "rendered-faces-64": "faces.png",
    "rendered-faces-128": "heads.webp",
    "cars-64": "cars.png",
}
LABELS_SHOWN, THUMBNAIL = 4, 96


@dataclass(frozen=True)
class ShownImage:
    """One opened image."""

    photo: UInt8[np.ndarray, "h w 3"]  # the photograph, its longer side at most ``studio.LARGEST_PHOTO``
    faces: tuple[Frame, ...]  # the frames of the faces found in it
    frame: Frame  # the part that the model was given
    framed: str  # how that was found: "face", "auto", "none", "no face" or "own"
    pixels: UInt8[np.ndarray, "3 s s"]  # that part at the model's size
    scene: Scene  # one scene, on the CPU
    features: Mapping[str, np.ndarray]  # by factor, (D,) each


class Shelf:
    """Opened images by names that cannot be guessed: at most ``limit``, and ``limit_bytes`` of photographs.

    When it is full, the image leaves that was not requested for longest; the last two stay.
    """

    def __init__(self, limit: int = KEPT, limit_bytes: int = KEPT_BYTES):
        if limit < 2:
            raise ValueError(f"a shelf needs room for 2 images or more, for swaps; got {limit}")
        self.limit, self.limit_bytes = limit, limit_bytes
        self._images: OrderedDict[str, ShownImage] = OrderedDict()

    def __len__(self) -> int:
        return len(self._images)

    def put(self, image: ShownImage) -> str:
        """Store an image; returns its name."""
        name = secrets.token_urlsafe(16)
        self._images[name] = image
        while len(self._images) > (self.limit if self._kept_bytes() <= self.limit_bytes else 2):
            self._images.popitem(last=False)
        return name

    def _kept_bytes(self) -> int:
        return sum({id(image.photo): image.photo.nbytes for image in self._images.values()}.values())

    def get(self, name: str) -> ShownImage:
        """The image of that name, which now counts as used; ``Refused`` (410) if it has left."""
        if name not in self._images:
            raise Refused(410, f"this image is no longer stored (the last {self.limit} are): open it again")
        self._images.move_to_end(name)
        return self._images[name]


@dataclass(frozen=True)
class Example:
    """An image to choose, and its name on the page."""

    name: str
    picture: UInt8[np.ndarray, "h w 3"]

    def thumbnail(self, size: int = THUMBNAIL) -> Image.Image:
        """Its middle square."""
        return ImageOps.fit(Image.fromarray(self.picture), (size, size))


def rendered_examples(model: str, image_size: int | None = None) -> list[Example]:
    """Rendered faces or cars for the bundled models, at their own size or another; none for other models."""
    if model not in ROWS:
        return []
    content = files("derender.report.viewer").joinpath(ROWS[model]).read_bytes()
    with Image.open(BytesIO(content)) as row:
        side = image_size or row.height
        size = (side * row.width // row.height, side)
        pixels = np.array(row.convert("RGB").resize(size, Image.Resampling.LANCZOS))
    tiles = np.split(pixels, pixels.shape[1] // side, axis=1)
    return [Example(f"example {number}", tile) for number, tile in enumerate(tiles, 1)]


class Gallery:
    """A table and the place of its images.

    ``source`` is that place, by default as the table records it, ``dataset`` its layout's name, or "auto".
    ``without_pictures`` says why no image can be shown, or is "".
    """

    def __init__(self, table: FeatureTable, source: str | None = None, dataset: str = "auto"):
        self.table, self.without_pictures = table, ""
        self._listed: ListedStream | None = None
        place = source if source is not None else str(table.origin.get("data", ""))
        try:
            self._listed = _listed(place, dataset)
        except (ValueError, OSError) as problem:
            if source is not None:
                raise
            self.without_pictures = " ".join(str(problem).split())
        files = () if self._listed is None else self._listed.table.files
        self._position = {file: row for row, file in enumerate(files)}
        if source is not None and not any(file in self._position for file in table.files):
            raise ValueError(f"{source} holds none of the table's images, such as {table.files[0]!r}")

    def shown(self, row: int) -> dict[str, Any]:
        """A row as JSON has it: its name, labels and image; None for an image that cannot be shown."""
        labels = [name for name in self.table.labels if name != "partition"][:LABELS_SHOWN]
        named = {name: str(self.table.labels[name][row]) for name in labels}
        try:
            image = data_url(pictures(self.picture(row, THUMBNAIL)[None])[0])
        except Refused:
            image = None
        return {"row": row, "file": self.table.files[row], "labels": named, "image": image}

    def picture(self, row: int, size: int) -> UInt8[np.ndarray, "3 s s"]:
        """The image of a row; ``Refused`` (404, 413, 415) where it cannot be shown."""
        if not 0 <= row < len(self.table):
            raise Refused(404, f"the table has {len(self.table):,} rows, there is no row {row}")
        file = self.table.files[row]
        if self._listed is None or file not in self._position:
            raise Refused(404, "the image of this row is not here: name its place with --data")
        sample = next(self._listed.samples(self._position[file]))
        try:
            encoded = sample.read()
        except (ValueError, OSError) as problem:
            raise Refused(404, "the image of this row can no longer be read") from problem
        return pixels_of(encoded, size, sample.box, sample.fit)

    def close(self) -> None:
        if self._listed is not None:
            self._listed.close()


def _listed(place: str, dataset: str) -> ListedStream:
    if not place:
        raise ValueError("the table does not record the place of its images: name it with --data")
    if not Path(parse_source(place)[0]).expanduser().exists():
        raise ValueError(f"{place} is not here: name the place of the images with --data")
    stream = open_images(place, dataset=dataset)
    if isinstance(stream, ListedStream):
        return stream
    stream.close()
    raise ValueError(f"{place} can only be read from its beginning: images of rows are not shown")


def data_url(image: Image.Image) -> str:
    """An image that travels inside JSON."""
    return data_uri(image_bytes(image, compress_level=1))
