"""Rows of a comparison: feature tables of the same images, checked against each other, and their labels.

A row is one kind of feature; several tables in one row are runs of the same thing (seeds). ``rows_of`` makes
rows of tables and models, ``prepare`` the arrays that protocols take. Leaves out controls (controls.py) and
scores.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from derender.data import ImageSet
from derender.evaluation.memory import Memory
from derender.features import FeatureTable, embed_pictures, missing, model_fingerprint, table_labels
from derender.inputs import Progress, as_images, as_model
from derender.model import Derenderer

ModelSource = Derenderer | str | Path
FeatureSource = FeatureTable | ModelSource
"""A table or its ``.parquet`` file; a model or its name."""

DEFAULT_FACTORS = ("geometry", "albedo")
SKIPPED_NAMED = 5
StageProgress = Callable[..., object]
"""Called with (done, total) and with ``description`` and ``unit``, the stage of the work."""


@dataclass(frozen=True)
class FeatureRow:
    """One kind of feature.

    Attributes:
        name: shown in the table.
        tables: one for each run.
        factors: the features to use, side by side; None means all.
        control: whether it learned nothing.
    """

    name: str
    tables: tuple[FeatureTable, ...]
    factors: tuple[str, ...] | None = None
    control: bool = False


@dataclass(frozen=True)
class Prepared:
    """The input of a protocol: arrays of the same N rows.

    Attributes:
        features: by name, one (N, D) array for each run.
        labels: by name, (N,).
        files: (N,) names of the rows.
        controls: names of the rows that learned nothing.
        n_dropped: rows left out before because a label was missing.
        partition: the owners' split, or None.
        kept: further label columns, by name.
    """

    features: dict[str, list[np.ndarray]]
    labels: dict[str, np.ndarray]
    files: tuple[str, ...]
    controls: tuple[str, ...]
    n_dropped: int
    partition: np.ndarray | None
    kept: dict[str, np.ndarray]


class SizedImages:
    """A data set read once for each image size that is needed; a set that is read already has one size.

    Attributes:
        notes: a sentence on each reading, and on the first images skipped.
    """

    def __init__(
        self,
        images: ImageSet | str | Path,
        *,
        dataset: str = "auto",
        limit: int | None = None,
        progress: StageProgress | None = None,
    ):
        self._images, self._how, self._progress = images, {"dataset": dataset, "limit": limit}, progress
        self._read: dict[int, ImageSet] = {}
        self.notes: list[str] = []

    def at(self, image_size: int) -> ImageSet:
        """The images at a side in pixels."""
        if image_size not in self._read:
            found = as_images(
                self._images, image_size, **self._how, progress=stage(self._progress, "reading")
            )
            if found.images.shape[-1] != image_size:
                raise ValueError(
                    f"the images have {found.images.shape[-1]} pixels a side and {image_size} are needed: "
                    "give the address of the data set instead"
                )
            self.notes += [found.describe()]
            self.notes += [f"skipped {row.file}: {row.reason}" for row in found.skipped[:SKIPPED_NAMED]]
            if len(found.skipped) > SKIPPED_NAMED:
                self.notes.append(f"and {len(found.skipped) - SKIPPED_NAMED:,} more skipped")
            self._read[image_size] = found
        return self._read[image_size]


def sized(images: ImageSet | str | Path | None, **how: Any) -> SizedImages | None:
    """``SizedImages`` of a set or an address; None without images."""
    return None if images is None else SizedImages(images, **how)


def stage(progress: StageProgress | None, description: str, unit: str = "images") -> Progress | None:
    """A callback of one stage's (done, total), which names the stage."""
    if progress is None:
        return None
    return lambda done, total: progress(done, total, description=description, unit=unit)


def rows_of(
    sources: Mapping[str, FeatureSource | Sequence[FeatureSource]],
    factors: Sequence[str] | None,
    images: SizedImages | None = None,
    *,
    memory: Memory,
    device: str = "auto",
    progress: StageProgress | None = None,
) -> list[FeatureRow]:
    """A row for each name: tables as they are, models applied to the images.

    Args:
        sources: by row name, a table or a model, or several runs of the same.
        factors: features to use; where a table has none of them, all it has. None means all.
        images: needed by models.
        memory: where embeddings are cached.
        device: of models that are loaded here.
        progress: called while embedding.

    Raises:
        ValueError: a model without images.
    """
    chosen, rows = None if factors is None else tuple(factors), []
    for name, runs in sources.items():
        tables = []
        for run in _runs(runs):
            if not is_model(run):
                tables.append(run if isinstance(run, FeatureTable) else FeatureTable.read(str(run)))
            elif images is None:
                raise ValueError(f"model {name!r} needs images to embed: give images")
            else:
                model = as_model(run, device=device)
                own = images.at(model.image_size)
                tables.append(embedded_table(model, own, memory, stage(progress, f"embedding {name}")))
        foreign = chosen is not None and not set(chosen) & set(tables[0].factors)
        rows.append(
            FeatureRow(name, tuple(tables), None if foreign else chosen, "control" in tables[0].origin)
        )
    return rows


def is_model(source: FeatureSource) -> TypeGuard[ModelSource]:
    """Whether a source is a model or its name, not a feature table or its file."""
    if isinstance(source, FeatureTable | Derenderer):
        return isinstance(source, Derenderer)
    return Path(source).suffix != ".parquet"


def model_sources(
    sources: Mapping[str, FeatureSource | Sequence[FeatureSource]],
) -> dict[str, list[ModelSource]]:
    """The models among the sources, by row name."""
    rows = {name: [run for run in _runs(runs) if is_model(run)] for name, runs in sources.items()}
    return {name: runs for name, runs in rows.items() if runs}


def _runs(runs: FeatureSource | Sequence[FeatureSource]) -> list[FeatureSource]:
    return [runs] if isinstance(runs, FeatureTable | Derenderer | str | Path) else list(runs)


def one_row(
    features: FeatureSource, factors: Sequence[str] | None, images: SizedImages | None = None, **how: Any
) -> FeatureRow:
    """The row of one table or model, named after its factors; further arguments as of ``rows_of``.

    Raises:
        ValueError: a table lacks a factor, and all of them are not the defaults.
    """
    name = "all" if factors is None else " + ".join(factors)
    (row,) = rows_of({name: features}, factors, images, **how)
    if factors is None or row.factors is not None:
        return row
    table = row.tables[0]
    if tuple(factors) != DEFAULT_FACTORS:
        table.concatenate(factors)  # raises: names the unknown factor
    return replace(row, name=" + ".join(table.factors))


def embedded_table(
    model: Derenderer, images: ImageSet, memory: Memory, progress: Progress | None = None
) -> FeatureTable:
    """A model's features of images, cached by the content of both."""
    weights = model_fingerprint(model)
    table = cached_table(
        memory, "embedding", {"weights": weights, "images": images.images}, images,
        lambda: embed_pictures(model, images, progress=progress),
    )  # fmt: skip
    origin = {"settings": model.settings.model_dump(mode="json"), "weights": weights}
    return replace(table, origin={**table.origin, **origin})


def cached_table(
    memory: Memory, what: str, inputs: Mapping[str, Any], images: ImageSet, make: Callable[[], FeatureTable]
) -> FeatureTable:
    """A feature table whose arrays are cached; names and labels come from the images."""
    factors = memory.recall(what, inputs, lambda: dict(make().factors))
    origin = {"data": images.source, "layout": images.layout}
    return FeatureTable(images.files, factors, table_labels(images), origin)


def aligned(images: ImageSet, files: Sequence[str]) -> ImageSet:
    """The images with these names, in this order."""
    if images.files == tuple(files):
        return images
    place = {file: row for row, file in enumerate(images.files)}
    absent = [file for file in files if file not in place]
    if absent:
        raise ValueError(
            f"{len(absent)} of {len(files)} rows of the table are not among the images of "
            f"{images.source} (first {absent[0]}): give the data that the table was made from"
        )
    return images.select([place[file] for file in files])


def chosen_labels(
    table: FeatureTable, label: str | Sequence[str] | None, attributes: bool, least: int = 1
) -> tuple[tuple[str, ...], list[str]]:
    """Label columns by name, or every yes/no column that has ``least`` rows of either answer; and notes.

    Raises:
        ValueError: neither or both were given, or no such label exists.
    """
    if bool(label) == attributes:
        raise ValueError("give either label, a name or several, or attributes")
    if attributes:
        return attribute_labels(table, least)
    names = tuple(dict.fromkeys([label] if isinstance(label, str) else label or ()))
    for name in names:
        table.label(name)
    return names, []


def attribute_labels(table: FeatureTable, least: int = 1) -> tuple[tuple[str, ...], list[str]]:
    """Every yes/no column that has ``least`` rows of either answer; a note names the others."""
    columns, names = attribute_columns(table), attribute_columns(table, least)
    if not columns:
        raise ValueError(f"there is no yes/no label; there is {', '.join(table.labels) or 'no label'}")
    rows = "no row" if least == 1 else f"fewer than {least} rows"
    if not names:
        raise ValueError(f"every yes/no label has {rows} of one of its answers: give more images")
    left = [name for name in columns if name not in names]
    return names, [f"left out, with {rows} of one of their answers: {', '.join(left)}"] if left else []


def attribute_columns(table: FeatureTable, least: int = 0) -> tuple[str, ...]:
    """Yes/no label columns (int8 with 1, 0 and -1 for unknown) that have ``least`` rows of either answer."""
    return tuple(
        name
        for name, values in table.labels.items()
        if values.dtype == np.int8 and min((values == 0).sum(), (values == 1).sum()) >= least
    )


def prepare(
    rows: Sequence[FeatureRow],
    labels: Sequence[str],
    *,
    mean_by: Sequence[str] = (),
    min_count: int = 1,
    max_count: int | None = None,
    keep: Sequence[str] = (),
) -> Prepared:
    """Check that all tables fit together; average, choose rows; labels are those of the first table.

    Args:
        rows: the first one's labels count.
        labels: columns to score by; an unknown name is an error with a suggestion.
        mean_by: average the features first over rows that share these labels, as for face tracks.
        min_count: leave out classes of fewer rows (with a single label only).
        max_count: keep at most that many rows of a class, the first ones (with a single label only).
        keep: further label columns to hand through.
    """
    check_rows(rows)
    first = rows[0].tables[0]
    columns = {name: first.label(name) for name in (*labels, *mean_by)}
    if (min_count > 1 or max_count is not None) and len(labels) != 1:
        raise ValueError(f"min_count and max_count go with one label, not with {len(labels)}")
    dropped, kept, chosen = 0, np.arange(len(first)), None
    if mean_by:
        absent = np.any([missing(column) for column in columns.values()], axis=0)
        dropped, kept = int(absent.sum()), np.flatnonzero(~absent)
        first = first.select(kept).mean_by(*mean_by)
        differing = [name for name in labels if name not in first.labels]
        if differing:
            raise ValueError(
                f"label {differing[0]!r} differs inside groups of {', '.join(mean_by)}: average by it too"
            )
    if min_count > 1 or max_count is not None:
        values = first.label(labels[0])
        chosen = np.union1d(at_least(values, min_count, max_count), np.flatnonzero(missing(values)))
        first = first.select(chosen)

    def array(row: FeatureRow, table: FeatureTable) -> np.ndarray:
        table = replace(table, labels=rows[0].tables[0].labels)
        if mean_by:
            table = table.select(kept).mean_by(*mean_by)
        return (table if chosen is None else table.select(chosen)).concatenate(row.factors)

    return Prepared(
        {row.name: [array(row, table) for table in row.tables] for row in rows},
        {name: first.label(name) for name in labels},
        first.files,
        tuple(row.name for row in rows if row.control),
        dropped,
        first.labels.get("partition"),
        {name: first.label(name) for name in keep},
    )


def at_least(labels: np.ndarray, count: int, most: int | None = None) -> np.ndarray:
    """Indices of the rows whose class has at least ``count`` members; of each class at most the first
    ``most``.

    LFW's protocol here is ``at_least(identity, 20, most=20)``: of its 31 people with 20 images one has 530,
    and with all of them that one person decides the purity (0.35 for any clustering at all).
    """
    labels = np.asarray(labels)
    present = np.flatnonzero(~missing(labels))
    places: dict[Any, list[int]] = {}
    for row, value in zip(present.tolist(), labels[present].tolist(), strict=True):
        places.setdefault(value, []).append(row)
    rows = [row for own in places.values() if len(own) >= count for row in own[:most]]
    if not rows:
        largest = max(map(len, places.values()), default=0)
        raise ValueError(f"no class has {count} members or more (the largest has {largest}): ask for fewer")
    return np.sort(np.array(rows))


def check_rows(rows: Sequence[FeatureRow]) -> None:
    """All tables are of the same images, names are unique, runs of one row are of one kind of model."""
    if not rows:
        raise ValueError("a comparison needs at least one feature table")
    names = [row.name for row in rows]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"two rows have the name {twice[0]!r}: give each its own")
    first = rows[0].tables[0]
    for row in rows:
        for table in row.tables:
            _check_same_images(rows[0].name, first, row.name, table)
            if _made_by(table) != _made_by(row.tables[0]):
                raise ValueError(
                    f"row {row.name!r} mixes features of different models (another kind, factors, sizes or "
                    "settings): several tables of one name are runs of the same model; give each model its "
                    "own name"
                )


def _check_same_images(name: str, first: FeatureTable, other_name: str, other: FeatureTable) -> None:
    if len(first) != len(other):
        raise ValueError(
            f"features {name!r} have {len(first)} rows and {other_name!r} {len(other)}: one table compares "
            "features of the same images; embed the same data for each"
        )
    differing = [(a, b) for a, b in zip(first.files, other.files, strict=True) if a != b]
    if differing:
        raise ValueError(
            f"features {name!r} and {other_name!r} are of different images, in {len(differing)} of "
            f"{len(first)} rows ({differing[0][0]} and {differing[0][1]}): embed the same data for each"
        )


def _made_by(table: FeatureTable) -> list[Any]:
    sizes = {factor: values.shape[1] for factor, values in table.factors.items()}
    return [sizes, *(table.origin.get(name) for name in ("model", "settings", "control"))]
