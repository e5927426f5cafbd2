"""From a folder, a zip, a picture or a stream to one array of decoded pictures with their labels."""

from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from derender.data.cache import cache_file, fingerprint, new_cache, read_cache
from derender.data.decode import READER_VERSION, check_fit
from derender.data.duplicates import Duplicate
from derender.data.inventory import Inventory, take_inventory
from derender.data.layout import Labels, count_unknown
from derender.data.loading import Loaded, Progress, load_into
from derender.data.names import suggestion
from derender.data.places import cache_folder
from derender.data.source import Skipped
from derender.data.stream.address import open_stream
from derender.data.stream.collect import collect

MEMORY_LIMIT_BYTES = 2 << 30
"""Sets larger than this (175,000 pictures of 64 x 64) are kept in a memory-mapped file instead of memory."""


@dataclass(frozen=True)
class PictureSet:
    """Decoded pictures, their labels, and what was left out.

    Attributes:
        images: (N, 3, S, S) RGB; a memory map for large sets.
        files: the name of each picture, relative to the source.
        labels: columns by name, one value per picture ("" / NaN / -1 where unknown: see data/layout.py).
        layout: the name of the layout they were read by ("utkface", "classes", "folder", ...).
        skipped: files that could not be read, with reasons.
        duplicates: files with the very pixels of an earlier one; not in ``images`` unless copies were kept.
        partition: the owners' own split of each picture ("train", "validation", "test", ...), or None.
        source: what was read.
        terms: on what terms the owners of a published set give it, in a few words.
    """

    images: UInt8[np.ndarray, "n 3 h w"]
    files: tuple[str, ...]
    labels: Labels = field(default_factory=dict)
    layout: str = "folder"
    skipped: tuple[Skipped, ...] = ()
    duplicates: tuple[Duplicate, ...] = ()
    partition: np.ndarray | None = None
    source: str = ""
    terms: str = ""

    def __post_init__(self) -> None:
        columns = {"files": self.files, **self.labels}
        if self.partition is not None:
            columns["partition"] = self.partition
        for name, column in columns.items():
            if len(column) != len(self.images):
                raise ValueError(f"{len(self.images)} pictures, but {len(column)} values in {name!r}")

    def __len__(self) -> int:
        return len(self.files)

    def select(self, indices: Shaped[np.ndarray, " k"] | list[int] | slice) -> "PictureSet":
        """The same set with only these rows: numbers, a true/false mask, or a slice.

        A slice shares the pictures' memory; other choices copy them.
        """
        rows = np.arange(len(self))[indices]
        return replace(
            self,
            images=self.images[indices],
            files=tuple(self.files[row] for row in rows),
            labels={name: column[rows] for name, column in self.labels.items()},
            partition=None if self.partition is None else self.partition[rows],
        )

    def label(self, name: str) -> np.ndarray:
        """One column of labels; an unknown name is an error that names those there are."""
        if name not in self.labels:
            known = f"it has {', '.join(self.labels)}" if self.labels else "it has no labels"
            raise ValueError(
                f"{self.source} ({self.layout}) has no label {name!r}{suggestion(name, self.labels)}; {known}"
            )
        return self.labels[name]

    def require(self, minimum: int, purpose: str = "training") -> "PictureSet":
        """The set itself if it holds enough pictures; otherwise an error that says so."""
        if len(self) < minimum:
            found = "only one picture was" if len(self) == 1 else f"only {len(self)} pictures were"
            left_out = len(self.skipped) + len(self.duplicates)
            note = f" ({left_out} more were unreadable or identical copies)" if left_out else ""
            raise ValueError(
                f"{purpose} needs {minimum:,} pictures or more, and {found} found "
                f"in {self.source}{note}; add pictures"
            )
        return self

    def describe(self) -> str:
        """One line: how many pictures, of which layout, what was left out."""
        noun = "picture" if len(self) == 1 else "pictures"
        parts = [f"{len(self):,} {noun} from {self.source} ({self.layout})"]
        if self.skipped:
            parts.append(f"{len(self.skipped):,} skipped")
        if self.duplicates:
            kept = set(self.files)
            verb = "kept" if all(row.file in kept for row in self.duplicates) else "dropped"
            parts.append(f"{len(self.duplicates):,} identical copies {verb}")
        unknown = {name: count_unknown(column) for name, column in self.labels.items()}
        partly = [f"{name} unknown for {count:,}" for name, count in unknown.items() if count]
        parts += (
            partly if len(partly) <= 3 else [*partly[:2], f"{len(partly) - 2} more labels in part unknown"]
        )
        return ", ".join(parts)


def read_pictures(
    source: str | Path,
    image_size: int,
    *,
    dataset: str = "auto",
    subset: str | None = None,
    fit: str = "crop",
    keep_duplicates: bool = False,
    limit: int | None = None,
    cache: str | Path | None = None,
    memory_limit_bytes: int = MEMORY_LIMIT_BYTES,
    workers: int | None = None,
    progress: Progress | None = None,
) -> PictureSet:
    """Read every picture of a folder, zip or stream at ``image_size`` x ``image_size``.

    Args:
        source: a folder, a zip, one picture, or ``PATH::SUBSET``; also shards and Hugging Face data sets
            (data/stream/address.py), which are always kept in a cache file.
        image_size: side of the square pictures, in pixels.
        dataset: the layout's name, or "auto" to recognise it.
        subset: a part of the data set ("train", "test_gt", a sub-folder); rendered sets: "train" by default.
        fit: what becomes of pictures that are not square: "crop" to the centre, "pad" with white, "stretch".
        keep_duplicates: keep all of identical pictures and not only the first; they are listed in any case.
        limit: read at most so many pictures, evenly spaced in the sorted list; of a stream the first.
        cache: a folder to keep decoded pictures in, whatever their size. None keeps sets above
            ``memory_limit_bytes`` in the user's cache folder (``DERENDER_CACHE`` names another), and
            others in memory.
        workers: threads; by default one for each core.
        progress: called with (done, total).
    """
    if not 1 <= image_size <= 4096:
        raise ValueError(f"image_size must be in 1..4096 pixels, got {image_size}")
    if limit is not None and limit < 1:
        raise ValueError(f"limit must be 1 or more, got {limit}")
    check_fit(fit)
    stream = open_stream(source, dataset=dataset, subset=subset)
    if stream is not None:
        folder = Path(cache) if cache is not None else cache_folder()
        stream.limit = limit
        with stream:
            collected = collect(
                stream,
                image_size,
                folder,
                fit=fit,
                keep_duplicates=keep_duplicates,
                workers=workers,
                progress=progress,
            )
        return PictureSet(
            images=collected.images,
            files=collected.loaded.files,
            labels=collected.labels,
            layout=stream.layout,
            skipped=collected.loaded.skipped,
            duplicates=collected.loaded.duplicates,
            partition=collected.partition,
            source=stream.source,
        )
    inventory = take_inventory(source, dataset=dataset, subset=subset)
    with inventory.source:
        files, boxes = inventory.table.files, inventory.table.boxes
        if limit is not None and limit < len(files):
            rows = np.linspace(0, len(files) - 1, limit).astype(int)
            files = tuple(files[row] for row in rows)
            boxes = None if boxes is None else boxes[rows]
        needed = len(files) * 3 * image_size * image_size
        how = _How(image_size, fit, keep_duplicates, limit, boxes, workers, progress)
        if cache is None and needed <= memory_limit_bytes:
            images = np.empty((len(files), 3, image_size, image_size), np.uint8)
            loaded = how.load(images, inventory, files)
            images = images[: len(loaded.files)]
        else:
            images, loaded = _through_cache(
                Path(cache) if cache is not None else cache_folder(), inventory, files, how
            )
    return _with_labels(inventory, images, loaded)


def as_float(images: UInt8[np.ndarray, "*n 3 h w"] | UInt8[Tensor, "*n 3 h w"]) -> Float[Tensor, "*n 3 h w"]:
    """Pictures of 0..255 as a float32 tensor of 0..1."""
    tensor = torch.from_numpy(np.array(images)) if isinstance(images, np.ndarray) else images
    return tensor.to(torch.float32) / 255


@dataclass(frozen=True)
class _How:
    """How to decode: the settings that pass through unchanged."""

    image_size: int
    fit: str
    keep_duplicates: bool
    limit: int | None
    boxes: np.ndarray | None
    workers: int | None
    progress: Progress | None

    @property
    def settings(self) -> tuple[object, ...]:
        """What the decoded rows depend on."""
        settings = (self.image_size, self.fit, self.keep_duplicates, self.limit)
        return settings if self.boxes is None else (*settings, sha256(self.boxes.tobytes()).hexdigest())

    def load(self, images: np.ndarray, inventory: Inventory, files: tuple[str, ...]) -> Loaded:
        loaded = load_into(
            images,
            inventory.source,
            files,
            fit=self.fit,
            keep_duplicates=self.keep_duplicates,
            boxes=self.boxes,
            progress=self.progress,
            workers=self.workers,
        )
        if not loaded.files:
            first = loaded.skipped[0]
            raise ValueError(
                f"none of the {len(files):,} pictures in {inventory.source.path} can be read; "
                f"the first is {first.file!r}: {first.reason}"
            )
        return loaded


def _through_cache(
    folder: Path, inventory: Inventory, files: tuple[str, ...], how: _How
) -> tuple[np.ndarray, Loaded]:
    """Rows from the cache file if it is good, else decoded into a new one."""
    settings = (READER_VERSION, inventory.layout.name, inventory.subset, *how.settings)
    path = inventory.source.path
    file = cache_file(folder, path.stem, (str(path.resolve()), settings))
    mark = fingerprint(inventory.source, files, settings)
    cached = read_cache(file, mark, how.image_size)
    if cached is None:
        with new_cache(file, len(files), how.image_size) as writer:
            writer.finish(how.load(writer.rows, inventory, files), mark)
        cached = read_cache(file, mark, how.image_size)
        if cached is None:
            raise OSError(f"decoded pictures could not be read back from {file}; check the disk")
    elif how.progress is not None:
        how.progress(len(files), len(files))
    return cached.images, cached.loaded


def _with_labels(inventory: Inventory, images: np.ndarray, loaded: Loaded) -> PictureSet:
    row_of = {file: row for row, file in enumerate(inventory.table.files)}
    table = inventory.table.select(np.array([row_of[file] for file in loaded.files], np.int64))
    where = (
        str(inventory.source.path)
        if inventory.subset is None
        else f"{inventory.source.path}::{inventory.subset}"
    )
    return PictureSet(
        images=images,
        files=loaded.files,
        labels=table.labels,
        layout=inventory.layout.name,
        skipped=(*inventory.source.skipped, *inventory.table.skipped, *loaded.skipped),
        duplicates=loaded.duplicates,
        partition=table.partition,
        source=where,
        terms=inventory.layout.terms,
    )
