"""The paper's tables for other features and models, beside the paper's numbers and controls.

The tables themselves are data (paper_tables.py). ``run_parts`` asks every question of a table that the labels
answer; which protocol answers it stands in ``RUNNERS``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from derender.data import ImageSet
from derender.evaluation.bootstrap import RESAMPLES, ScoredRow
from derender.evaluation.clustering import clustering_table, compare_clusterings
from derender.evaluation.clustering_methods import METHODS
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS
from derender.evaluation.controls import image_notes, with_controls
from derender.evaluation.feature_rows import (
    DEFAULT_FACTORS,
    FeatureRow,
    FeatureSource,
    ModelSource,
    SizedImages,
    StageProgress,
    aligned,
    attribute_labels,
    model_sources,
    prepare,
    rows_of,
    sized,
    stage,
)
from derender.evaluation.linear_finetune import finetuned_answers
from derender.evaluation.linear_head import PAPER_HEAD
from derender.evaluation.linear_probing import LinearComparison, compare_linear, linear_tables
from derender.evaluation.linear_task import choose_rows, task_of
from derender.evaluation.memory import Memory, memory_in
from derender.evaluation.paper_tables import ATTRIBUTES, PaperRow, Part, TableSpec, table_named
from derender.evaluation.score_table import (
    Cell,
    Column,
    Row,
    Scores,
    ScoreTable,
    interval_column,
    interval_of,
    scored_table,
    verdict_table,
)
from derender.evaluation.segmentation import SegmentSettings, segment
from derender.inputs import as_model

PAPER_VARIANTS = ("joint", "geometry", "albedo", "joint-frozen", "random")


def compare(
    table: str,
    features: Mapping[str, FeatureSource | Sequence[FeatureSource]],
    images: ImageSet | str | Path | None = None,
    *,
    factors: Sequence[str] | None = DEFAULT_FACTORS,
    method: str = "ward",
    counts: Sequence[int] = (100, 500, 1_000),
    seeds: int = 5,
    finetune: bool = False,
    masks: str | Path | None = None,
    epochs: int = 20,
    untrained_seeds: int = 3,
    resamples: int = RESAMPLES,
    seed: int = 0,
    dataset: str = "auto",
    limit: int | None = None,
    device: str = "auto",
    cache: Memory | str | Path | None = None,
    progress: StageProgress | None = None,
) -> Scores:
    """One of the paper's tables for several features and models, beside the paper's numbers and controls.

    Args:
        table: "clustering", "identity", "emotion", "linear", "cars", or "segmentation" (of models alone).
        features: by row name, feature tables and models, or several runs (seeds) of the same.
        images: a data set or its address: of the models, and of the controls.
        factors: features to use, side by side; None means all.
        method: of clustering tables: "ward", "finch" or "k-means".
        counts: of the linear table: numbers of labelled rows to learn from.
        seeds: random training subsets; of segmentation runs of each net.
        finetune: of the linear table: also train the encoders of the models with the head.
        masks, epochs: of segmentation: a folder of masks that are not with the images; of training.
        untrained_seeds: untrained encoders to average over.
        resamples: bootstrap resamples of the rows.
        seed: the first seed.
        dataset, limit: how ``images`` are read.
        device: of models.
        cache: folder of cached results, "none" for none; by default the user's.
        progress: called with (done, total, description=..., unit=...).

    Raises:
        ValueError: an unknown table, or labels, factors or images that do not fit.
    """
    spec, memory = table_named(table), memory_in(cache)
    models, runs = model_sources(features), range(seed, seed + seeds)
    if spec.kind == "segment":
        if images is None or isinstance(images, ImageSet) or not models or len(models) < len(features):
            raise ValueError(
                f"table {table!r} trains nets from a model's encoders, and features do not do: give models "
                "and the address of images that have masks"
            )
        read_as = {"masks": masks, "dataset": dataset, "limit": limit}
        how_trained = {"settings": SegmentSettings(epochs=epochs), "resample_count": resamples}
        return segmentation_table(
            spec, models, device, data=images, seeds=runs, memory=memory, progress=progress, **read_as,
            **how_trained,
        )  # fmt: skip
    if masks is not None:
        raise ValueError(f"masks go with the table of segmentation, not with {table}")
    if models and images is None:
        raise ValueError(f"model {next(iter(models))!r} needs images to embed: give images")
    if finetune and (spec.kind != "linear" or not models):
        raise ValueError("finetune trains the encoders of models: give the linear table, models and images")
    read = sized(images, dataset=dataset, limit=limit, progress=progress)
    rows = rows_of(features, factors, read, memory=memory, device=device, progress=progress)
    rows = with_controls(
        rows, read, factors, range(seed, seed + untrained_seeds), memory=memory, device=device,
        progress=progress,
    )  # fmt: skip
    how = How(
        method, tuple(counts), runs, resamples, seed, memory, progress,
        Finetuning(models, read, factors, device) if finetune and read is not None else None,
    )  # fmt: skip
    parts = [part for part in spec.parts if part.columns(rows[0].tables[0])]
    if not parts:
        needed = " or ".join(", ".join(part.labels) for part in spec.parts)
        have = ", ".join(rows[0].tables[0].labels) or "none"
        raise ValueError(
            f"table {spec.name!r} needs labels ({needed}), the features have {have}: embed other data"
        )
    tables: list[ScoreTable] = []
    values: dict[str, Any] = {}
    notes = image_notes(read)
    for part in parts:
        shown, values[part.name], own_notes = RUNNERS[spec.kind](spec, part, rows, how)
        tables += shown
        notes += own_notes
    numbers = {"table": spec.name, "number": spec.number, "parts": values}
    return Scores(tables, numbers, [*notes, memory.summary()])


@dataclass(frozen=True)
class Finetuning:
    """The models whose encoders are trained, and their images."""

    models: Mapping[str, Sequence[ModelSource]]
    images: SizedImages
    factors: Sequence[str] | None
    device: str


@dataclass(frozen=True)
class How:
    """How a table is made, whatever its kind."""

    method: str
    counts: tuple[int, ...]
    seeds: Sequence[int]
    resamples: int
    seed: int
    memory: Memory
    progress: StageProgress | None
    finetuning: Finetuning | None


PartOutcome = tuple[list[ScoreTable], dict[str, Any], list[str]]


def cluster_part(spec: TableSpec, part: Part, rows: Sequence[FeatureRow], how: How) -> PartOutcome:
    """One question of a clustering table: tables, numbers and notes."""
    first = rows[0].tables[0]
    columns, notes = _columns(part, rows, 1)
    ready = prepare(rows, columns, **asdict(part.rows(first)))
    found = compare_clusterings(
        ready.features, ready.labels, controls=ready.controls, method=how.method,
        resample_count=how.resamples, seed=how.seed, memory=how.memory,
    )  # fmt: skip
    differs = part.differs(_layout(first), found.n_rows)
    caption = f"{part.name}, beside the paper's Table {spec.number} ({METHODS[found.method]})"
    shown = {name: CLUSTER_COLUMNS[name] for name in ("accuracy", "f1")}
    tables = [
        beside_the_paper(caption, "features", found.rows, shown, part.paper, differs, interval="accuracy"),
        clustering_table(found),
        verdict_table(found.rows, CLUSTER_COLUMNS, f"{part.name}: above the strongest control?"),
    ]
    if ready.n_dropped:
        notes.append(f"{part.name}: {ready.n_dropped:,} rows without a label left out before averaging")
    more = {"n_dropped_before": ready.n_dropped, "differs": differs, "paper": part.paper}
    return tables, {**found.numbers(), **more}, notes


def linear_part(spec: TableSpec, part: Part, rows: Sequence[FeatureRow], how: How) -> PartOutcome:
    """One question of a linear table: tables, numbers and notes."""
    first = rows[0].tables[0]
    columns, notes = _columns(part, rows, 2)
    ready = prepare(rows, columns)
    task = task_of(ready.labels)
    split = choose_rows(task, ready.files, how.counts, how.seeds, partition=ready.partition)
    tuned = None
    if how.finetuning is not None:
        one = how.finetuning
        tuned = finetuned_answers(
            {name: [as_model(run, device=one.device) for run in runs] for name, runs in one.models.items()},
            lambda size: aligned(one.images.at(size), ready.files).images,
            ready, task, split, how.seeds, one.factors, PAPER_HEAD, how.memory, how.progress,
        )  # fmt: skip
    found = compare_linear(
        ready.features, task, split, how.seeds, controls=ready.controls, finetuned=tuned,
        resample_count=how.resamples, memory=how.memory, progress=stage(how.progress, "probing", "probes"),
    )  # fmt: skip
    differs = part.differs(_layout(first), len(ready.files))
    tables = [
        beside_the_papers_heads(part.name, spec.number, part.paper, found, differs),
        *linear_tables(found),
    ]
    return tables, {**found.numbers(), "differs": differs, "paper": part.paper}, notes


def segmentation_table(
    spec: TableSpec, models: Mapping[str, Sequence[ModelSource]], device: str, memory: Memory, **how: Any
) -> Scores:
    """The table of segmentation, once for each model; further arguments as of ``segment``."""
    tables: list[ScoreTable] = []
    values = {}
    for name, (model, *others) in models.items():
        if others:
            raise ValueError(f"two models have the name {name!r}: give each its own")
        found = segment(as_model(model, device=device), variants=PAPER_VARIANTS, memory=memory, **how)
        shown = (found.tables[-1], *found.tables[:-1])
        tables += [replace(table, caption=f"{name}: {table.caption}") for table in shown]
        paper = {"differs": found.result.differs, "paper": spec.parts[0].paper}
        values[name] = {**found.result.numbers(), **paper}
    numbers = {"table": spec.name, "number": spec.number, "parts": values}
    return Scores(tables, numbers, [memory.summary()])


RUNNERS: dict[str, Callable[[TableSpec, Part, Sequence[FeatureRow], How], PartOutcome]] = {
    "cluster": cluster_part,
    "linear": linear_part,
}
"""By kind of table; segmentation takes models instead of features."""


def beside_the_paper(
    caption: str,
    first: str,
    rows: Sequence[ScoredRow],
    columns: Mapping[str, Column],
    paper: Sequence[PaperRow],
    differs: str,
    interval: str | None = None,
) -> ScoreTable:
    """Scored rows over the paper's lines; the last column is the data set, or how the data differ from it.

    Args:
        caption, first, rows, columns: see ``scored_table``.
        paper: the paper's lines.
        differs: of the rows' data.
        interval: the score whose interval is shown; None for none.
    """
    more: dict[Column, Callable[[ScoredRow], Cell]] = {}
    if interval is not None:
        more[interval_column(columns[interval])] = lambda row: interval_of(row, interval)
    more[Column("data")] = lambda _: differs
    table = scored_table(caption, first, rows, columns, intervals=(), deviations=(), more=more)
    blank = [None] * (len(more) - 1)
    lines = [
        Row(f"paper: {row.method}", (*map(row.scores.get, columns), *blank, row.dataset), note="paper")
        for row in paper
    ]
    return replace(table, rows=[*table.rows, *lines])


def beside_the_papers_heads(
    name: str, number: int, paper: Sequence[PaperRow], found: LinearComparison, differs: str
) -> ScoreTable:
    """Accuracies of the paper's head by number of labels, frozen and fine-tuned, over the paper's own."""
    shown = {f"{one.head} {one.count}": one for one in found.parts if one.head in ("linear", "fine-tuned")}
    columns = [
        Column(f"{one.count:,} {'frozen' if one.head == 'linear' else one.head}", "high")
        for one in shown.values()
    ]
    accuracies = {
        key: {row.name: row.scores["accuracy"].value for row in one.rows} for key, one in shown.items()
    }
    names = {row.name: row.control for one in shown.values() for row in one.rows}
    rows = [
        Row(row, (*(accuracies[key].get(row) for key in shown), differs), control)
        for row, control in names.items()
    ]
    lines: dict[str, dict[str, float]] = {}
    for row in paper:
        lines.setdefault(row.method, {}).update(row.scores)
    rows += [
        Row(f"paper: {method}", (*map(scores.get, shown), paper[0].dataset), note="paper")
        for method, scores in lines.items()
        if any(key in scores for key in shown)
    ]
    caption = f"{name}: accuracy of the paper's head, beside the paper's Table {number}"
    return ScoreTable(caption, "features", (*columns, Column("data")), rows)


def _columns(part: Part, rows: Sequence[FeatureRow], least: int) -> tuple[tuple[str, ...], list[str]]:
    """The labels of a question (yes/no ones need ``least`` rows of either answer), and notes."""
    table = rows[0].tables[0]
    return attribute_labels(table, least) if part.labels == (ATTRIBUTES,) else (part.columns(table), [])


def _layout(table: Any) -> str:
    return str(table.origin.get("layout", "unknown data"))
