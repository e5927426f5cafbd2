"""Rows of a comparison: feature tables of the same images, checked against each other, labels and controls.

A row is one kind of feature; several tables in one row are runs of the same thing (seeds). ``row_of`` makes
one of tables and models, ``prepare`` the arrays that protocols take. Leaves out scores.

Controls are made of the same images without learning: an untrained encoder of the same architecture (several
seeds), principal components and the pixels themselves. Tables of identity and class also have descriptors, of
the image alone and averaged with those of its mirror image: whitened features see both.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from derender.baselines import load_baseline
from derender.baselines.controls import control_table, descriptor_features, pca_features, pixel_features
from derender.data import ImageSet
from derender.evaluation.options import DEFAULT_FACTORS, Options
from derender.evaluation.pixels import component_count
from derender.features import FeatureTable, embed_images, missing, table_labels
from derender.features.extract import model_facts
from derender.inputs import as_model, device_named
from derender.model import Derenderer
from derender.presets import ModelSettings
from derender.storage.bounded import first_line
from derender.storage.folder import CONFIG_FILE, saved_config

ModelSource = Derenderer | str | Path
FeatureSource = FeatureTable | ModelSource  # also a table's .parquet file, a name, a baseline's run folder
UNTRAINED = "untrained encoder"
DESCRIPTORS_SHOWN = {"gradientfaces": "Gradientfaces", "hog": "HOG", "lbp": "LBP"}


@dataclass(frozen=True)
class FeatureRow:
    """One kind of feature: a table for each run, factors to use (None: all); a control learned nothing."""

    name: str
    tables: tuple[FeatureTable, ...]
    factors: tuple[str, ...] | None = None
    control: bool = False

    def arrays(self) -> list[np.ndarray]:
        """One (N, D) array for each run."""
        return [table.concatenate(self.factors) for table in self.tables]


@dataclass(frozen=True)
class Prepared:
    """Arrays of the same N rows: features by name, (N, D) for each run, and the labels asked, (N,).

    ``table`` is the first row's, with names and all labels; ``n_dropped`` rows were left out before.
    """

    features: dict[str, list[np.ndarray]]
    labels: dict[str, np.ndarray]
    table: FeatureTable
    controls: tuple[str, ...]
    n_dropped: int

    @property
    def asked(self) -> dict[str, Any]:
        """Features, labels and controls, as comparisons take them."""
        return {"features": self.features, "labels": self.labels, "controls": self.controls}

    @property
    def split(self) -> dict[str, Any]:
        """File names and the owners' split, as ``choose_rows`` takes them."""
        return {"files": self.table.files, "partition": self.table.labels.get("partition")}


def row_of(name: str, runs: FeatureSource | Sequence[FeatureSource], options: Options) -> FeatureRow:
    """A row of one source or several runs: tables as they are, models applied to the images.

    Where a table has none of the factors chosen, all that it has are used.
    """
    tables = []
    for run in runs_of(runs):
        if isinstance(run, FeatureTable):
            tables.append(run)
        elif not is_model(run):
            tables.append(FeatureTable.read(str(run)))
        elif options.images is None:
            raise ValueError(f"model {name!r} needs images to embed: give images")
        else:
            model = opened(run, options.device)
            tables.append(embedded_table(model, options.at(model.image_size), options, f"embedding {name}"))
    chosen = options.chosen if set(options.chosen or ()) & set(tables[0].factors) else None
    return FeatureRow(name, tuple(tables), chosen, "control" in tables[0].origin)


def opened(source: ModelSource, device: str) -> Any:
    """A model ready for use: ours, or the baseline in a run folder."""
    if not isinstance(source, Derenderer):
        for folder in (Path(source), Path(source) / "model"):
            if (folder / CONFIG_FILE).is_file() and "baseline" in saved_config(folder):
                return load_baseline(folder).to(device_named(device))
    return as_model(source, device=device)


def is_model(source: FeatureSource) -> TypeGuard[ModelSource]:
    """Whether a source is a model or its name, not a feature table or its file."""
    if isinstance(source, FeatureTable | Derenderer):
        return isinstance(source, Derenderer)
    return Path(source).suffix != ".parquet"


def runs_of(runs: FeatureSource | Sequence[FeatureSource]) -> list[FeatureSource]:
    """One source, or several, as a list."""
    return [runs] if isinstance(runs, FeatureTable | Derenderer | str | Path) else list(runs)


def embedded_table(model: Any, images: ImageSet, options: Options, stage: str = "embedding") -> FeatureTable:
    """A model's features of images, cached by the content of both; names and labels are the images'."""
    origin = model_facts(model, images.source, images.layout)
    inputs = {"weights": origin["weights"], "images": images.images}
    make = partial(embed_images, model, images.images, progress=options.stage(stage))
    factors = options.memory.recall("embedding", inputs, make)
    return FeatureTable(images.files, factors, table_labels(images), origin)


def chosen_labels(
    table: FeatureTable, label: str | Sequence[str] | None, attributes: bool, least: int = 1
) -> tuple[tuple[str, ...], list[str]]:
    """Label columns by name, or every yes/no column that has ``least`` rows of either answer; and notes.

    Raises:
        ValueError: neither or both were given, or no such label exists.
    """
    if bool(label) == attributes:
        raise ValueError("give either label, a name or several, or attributes")
    if not attributes:
        names = tuple(dict.fromkeys([label] if isinstance(label, str) else label or ()))
        for name in names:
            table.label(name)
        return names, []
    columns, names = attribute_columns(table.labels), attribute_columns(table.labels, least)
    if not columns:
        raise ValueError(f"there is no yes/no label; there is {', '.join(table.labels) or 'no label'}")
    rows = "no row" if least == 1 else f"fewer than {least} rows"
    if not names:
        raise ValueError(f"every yes/no label has {rows} of one of its answers: give more images")
    left = [name for name in columns if name not in names]
    return names, [f"left out, with {rows} of one of their answers: {', '.join(left)}"] if left else []


def attribute_columns(labels: Mapping[str, np.ndarray], least: int = 0) -> tuple[str, ...]:
    """Yes/no label columns (int8 with 1, 0 and -1 for unknown) that have ``least`` rows of either answer."""
    answers = {name: values for name, values in labels.items() if values.dtype == np.int8}
    return tuple(name for name, own in answers.items() if min((own == 0).sum(), (own == 1).sum()) >= least)


def prepare(
    rows: Sequence[FeatureRow], labels: Sequence[str], *, mean_by: Sequence[str] = (), min_count: int = 1,
    max_count: int | None = None,
) -> Prepared:  # fmt: skip
    """Check that all tables fit together; average, choose rows; labels are those of the first table.

    Args:
        rows, labels: of features; the columns to score by.
        mean_by: average the features first over rows that share these labels, as for face tracks.
        min_count, max_count: leave out classes of fewer rows; keep the first rows of a class (single labels).
    """
    check_rows(rows)
    first = rows[0].tables[0]
    absent = np.any([missing(first.label(name)) for name in (*labels, *mean_by)], axis=0)

    def averaged(table: FeatureTable) -> FeatureTable:
        table = replace(table, labels=first.labels)
        return table.select(~absent).mean_by(*mean_by) if mean_by else table

    table = averaged(first)
    if differing := [name for name in labels if name not in table.labels]:
        groups = f"groups of {', '.join(mean_by)}"
        raise ValueError(f"label {differing[0]!r} differs inside {groups}: average by it too")
    kept = np.arange(len(table))
    if min_count > 1 or max_count is not None:
        if len(labels) != 1:
            raise ValueError(f"min_count and max_count go with one label, not with {len(labels)}")
        values = table.label(labels[0])
        kept = np.union1d(at_least(values, min_count, max_count), np.flatnonzero(missing(values)))
    n_dropped = len(table) - len(kept) + (int(absent.sum()) if mean_by else 0)
    table = table.select(kept)
    arrays = {
        row.name: [averaged(one).select(kept).concatenate(row.factors) for one in row.tables] for row in rows
    }
    known = {name: table.label(name) for name in labels}
    return Prepared(arrays, known, table, tuple(row.name for row in rows if row.control), n_dropped)


def at_least(labels: np.ndarray, count: int, most: int | None = None) -> np.ndarray:
    """Indices of the rows whose class has ``count`` members or more; of each class the first ``most``.

    LFW's protocol here is ``at_least(identity, 20, most=20)``. One of its 31 people with 20 images has 530:
    all of these would decide the purity (0.35 for any clustering at all).
    """
    labels, places = np.asarray(labels), defaultdict(list)
    for row in np.flatnonzero(~missing(labels)).tolist():
        places[labels[row]].append(row)
    rows = [row for own in places.values() if len(own) >= count for row in own[:most]]
    if not rows:
        largest = max(map(len, places.values()), default=0)
        raise ValueError(f"no class has {count} members or more (the largest has {largest}): bring more")
    return np.sort(np.array(rows))


def check_lengths(features: Mapping[str, Sequence[np.ndarray]], n_rows: int) -> None:
    """Every array of features has as many rows as there are labels."""
    for name, arrays in features.items():
        if other := [len(array) for array in arrays if len(array) != n_rows]:
            fix = "all features of one table must be of the same images"
            raise ValueError(f"features {name!r} have {other[0]} rows, the labels {n_rows}: {fix}")


def check_rows(rows: Sequence[FeatureRow]) -> None:
    """All tables are of the same images, names are unique, runs of one row are of one kind of model."""
    if not rows:
        raise ValueError("a comparison needs at least one feature table: give features, or models and images")
    names = [row.name for row in rows]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two rows have the name {twice[0]!r}: give each its own")
    first, fix = rows[0].tables[0], "embed the same data for each"
    for row in rows:
        for table in row.tables:
            if len(first) != len(table):
                what = f"features {names[0]!r} have {len(first)} rows and {row.name!r} {len(table)}"
                raise ValueError(f"{what}: one table compares features of the same images; {fix}")
            if other := [pair for pair in zip(first.files, table.files, strict=True) if pair[0] != pair[1]]:
                what = f"features {names[0]!r} and {row.name!r} are of different images"
                where = f"in {len(other)} of {len(first)} rows ({other[0][0]} and {other[0][1]})"
                raise ValueError(f"{what}, {where}: {fix}")
            if _made_by(table) != _made_by(row.tables[0]):
                what = f"row {row.name!r} mixes features of different models"
                rule = "several tables of one name are runs of the same model; give each model its own name"
                raise ValueError(f"{what} (another kind, factors, sizes or settings): {rule}")


def _made_by(table: FeatureTable) -> list[Any]:
    sizes = {factor: values.shape[1] for factor, values in table.factors.items()}
    return [sizes, *(table.origin.get(name) for name in ("model", "settings", "control"))]


def subject_and_controls(features: FeatureSource, options: Options) -> list[FeatureRow]:
    """The row of one table or model, named after its factors, and behind it the controls of its images.

    The default factors are all where a table has none of them; others that it lacks are a ValueError.
    """
    chosen = options.chosen
    row = row_of("all" if chosen is None else " + ".join(chosen), features, options)
    if chosen is not None and row.factors is None:
        if chosen != DEFAULT_FACTORS:
            row.tables[0].concatenate(chosen)  # raises: names the unknown factor
        row = replace(row, name=" + ".join(row.tables[0].factors))
    return with_controls([row], options)


def with_controls(rows: Sequence[FeatureRow], options: Options) -> list[FeatureRow]:
    """The rows, and behind them the controls of their images; without images there are none."""
    check_rows(rows)
    if options.images is None:
        options.notes.append("without images there are no pixels, PCA and untrained encoder to compare with")
        return list(rows)
    settings = architecture(rows)
    size = 64 if settings is None else settings.network.image_size
    return [*rows, *control_rows(options.at(size, rows[0].tables[0].files), settings, options)]


def control_rows(
    images: ImageSet, settings: ModelSettings | None, options: Options, fit_on: ImageSet | None = None
) -> list[FeatureRow]:
    """The controls of every protocol on features: an untrained encoder, PCA and pixels.

    Without ``settings``, an architecture, there is no untrained encoder. PCA gets its components from
    ``fit_on``, by default ``images``.
    """
    rows, tables = [], []
    if settings is not None:
        for seed in options.seeds(options.untrained_seeds):
            encoder = Derenderer.seeded(settings, seed).to(device_named(options.device)).eval()
            table = embedded_table(encoder, images, options, f"{UNTRAINED} {seed}")
            tables.append(replace(table, origin={**table.origin, "control": "untrained", "seed": seed}))
        rows.append(FeatureRow(UNTRAINED, tuple(tables), options.chosen, control=True))
    fitted = fit_on or images
    components = component_count(len(fitted))  # whitening needs many more rows than components
    inputs = {"images": images.images, "components": components, "fit_on": fitted.images}
    pca = options.memory.recall_one(
        "pca", inputs, lambda: pca_features(images, components=components, fit_on=fitted).factors["pca"]
    )
    table, name = control_table(images, "pca", pca, {"components": components}), f"PCA ({components})"
    rows.append(FeatureRow(name, (table,), control=True))
    options.notes.append(f"{name}, whitened, is fitted to {len(fitted):,} images of {fitted.source}")
    rows.append(FeatureRow("pixels", (pixel_features(images),), control=True))
    for name, shown in DESCRIPTORS_SHOWN.items() if options.descriptors else ():
        try:
            table = descriptor_features(name, images, progress=options.stage(name))
            mirrored = replace(images, images=np.ascontiguousarray(images.images[..., ::-1]))
            other = descriptor_features(name, mirrored, progress=options.stage(f"{name} of mirror images"))
        except ValueError as error:  # a package is missing, or images are smaller than a cell
            options.notes.append(f"{name} left out: {error}")
        else:
            both = replace(table, factors={name: (table.factors[name] + other.factors[name]) / 2})
            rows.append(FeatureRow(shown, (table,), control=True))
            rows.append(FeatureRow(f"{shown} with mirror image", (both,), control=True))
    return rows


def architecture(rows: Sequence[FeatureRow]) -> ModelSettings | None:
    """The model settings of the first row that a ``Derenderer`` made; None if there is none."""
    for row in rows:
        origin, ours = row.tables[0].origin, Derenderer.__name__
        stored = origin.get("settings") if origin.get("model", ours) == ours else None
        if stored is not None and not row.control:
            try:
                return ModelSettings.model_validate(stored)
            except ValueError as error:
                what = f"features {row.name!r} were made by a model this version does not know"
                raise ValueError(f"{what} ({first_line(error)}): embed the data again") from error
    return None
