"""The paper's tables for the features and models a user has: which rows, which protocol, what is shown.

What a table is stands as data in ``evaluation/tables.py``. A table of features has a runner in ``RUNNERS``,
which takes the table's part, the rows and the options and gives the tables to show and the numbers for JSON.
Segmentation trains nets and takes models alone. Leaves out the command (compare.py).
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import feature_rows, options
from derender.cli.console import progress_bar
from derender.cli.evaluate.segment import Masks, MaskSource, segmented

if TYPE_CHECKING:
    import numpy as np

    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.memory import Memory
    from derender.evaluation.score_table import ScoreTable
    from derender.evaluation.tables import Part, TableSpec

PAPER_VARIANTS = "joint,geometry,albedo,joint-frozen,random"

Named = Annotated[
    list[str] | None,
    typer.Option(
        "--features", "-f", help="A table made by derender embed; a name given again is another seed.",
        metavar="NAME=FILE.parquet",
    ),
]  # fmt: skip
Models = Annotated[
    list[str] | None, typer.Option("--model", "-m", help="A model, with --data.", metavar="NAME=MODEL")
]
Data = Annotated[
    str | None,
    typer.Option("--data", "-d", help="Pictures: of the models, and of the controls.", metavar="PATH"),
]


@dataclass(frozen=True)
class Given:
    """What is compared."""

    features: Named = None
    model: Models = None
    data: Data = None
    dataset: options.Dataset = "auto"
    limit: options.Limit = None
    factors: feature_rows.Factors = "geometry,albedo"
    masks: Masks = None


@dataclass(frozen=True)
class Choices:
    """How a table is made, whatever its kind."""

    seeds: int
    counts: tuple[int, ...]
    method: str
    epochs: int
    resamples: int
    seed: int
    finetuned: "Callable[..., dict[str, dict[int, np.ndarray]]] | None" = None


def finetuning(
    given: Given, pictures: "feature_rows.Pictures", device: str, memory: "Memory"
) -> "Callable[..., Any]":
    """Fine-tuned answers of the models given, for whoever asks them a task."""
    from derender.cli.finetuned import all_finetuned
    from derender.cli.models import open_model
    from derender.evaluation.linear_head import PAPER_HEAD

    named = feature_rows.named_paths(given.model or (), "--model")
    models = {name: [open_model(path, device) for path in paths] for name, paths in named.items()}

    def answers(ready: Any, task: Any, split: Any, seeds: tuple[int, ...]) -> Any:
        return all_finetuned(
            models,
            lambda size: feature_rows.aligned(pictures.at(size), ready.files).images,
            ready, task, split, seeds, feature_rows.factors_of(given.factors), PAPER_HEAD, memory,
        )  # fmt: skip

    return answers


def run_parts(
    spec: "TableSpec", rows: "list[FeatureRow]", choices: Choices, memory: "Memory"
) -> "tuple[list[ScoreTable], dict[str, Any]]":
    """Every question of a table that the labels answer."""
    parts = [part for part in spec.parts if part.columns(rows[0].tables[0])]
    if not parts:
        wanted = " or ".join(", ".join(part.labels) for part in spec.parts)
        have = ", ".join(rows[0].tables[0].labels) or "none"
        raise ValueError(
            f"table {spec.name!r} needs labels ({wanted}), the features have {have}: embed other data"
        )
    tables: list[ScoreTable] = []
    values: dict[str, Any] = {}
    for part in parts:
        shown, values[part.name] = RUNNERS[spec.kind](spec, part, rows, choices, memory)
        tables += shown
    return tables, values


def columns_of(part: "Part", rows: "list[FeatureRow]", least: int) -> tuple[str, ...]:
    """The labels that answer a question; of yes/no ones those with ``least`` rows of either answer."""
    from derender.evaluation.tables import ATTRIBUTES

    table = rows[0].tables[0]
    if part.labels == (ATTRIBUTES,):
        return feature_rows.asked_attributes(table, least)
    return part.columns(table)


def run_segment(
    given: Given, choices: Choices, device: str, memory: "Memory"
) -> "tuple[list[ScoreTable], dict[str, Any]]":
    """The table of segmentation, once for each model."""
    from derender.evaluation.tables import SEGMENTATION

    if given.features or not given.model or given.data is None:
        raise ValueError(
            "table 'segmentation' trains nets from a model's encoders, and features do not do: give --model "
            "NAME=MODEL with --data D, pictures with masks"
        )
    pictures = MaskSource(given.data, given.masks, given.dataset, given.limit)
    seeds = tuple(range(choices.seed, choices.seed + choices.seeds))
    tables: list[ScoreTable] = []
    values: dict[str, Any] = {}
    for name, paths in feature_rows.named_paths(given.model, "--model").items():
        if len(paths) > 1:
            raise ValueError(f"two models have the name {name!r}: give each its own")
        run = segmented(
            paths[0], pictures, PAPER_VARIANTS, seeds, memory,
            epochs=choices.epochs, resamples=choices.resamples, device=device,
        )  # fmt: skip
        tables += [
            replace(table, caption=f"{name}: {table.caption}") for table in (run.tables[-1], *run.tables[:-1])
        ]
        values[name] = {**run.found.numbers(), "differs": run.differs, "paper": SEGMENTATION.paper}
    return tables, values


def run_cluster(
    spec: "TableSpec", part: "Part", rows: "list[FeatureRow]", choices: Choices, memory: "Memory"
) -> "tuple[list[ScoreTable], Mapping[str, Any]]":
    """One question of a clustering table."""
    from derender.evaluation.clustering_compare import compare_clusterings
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.score_table import verdict_table
    from derender.report.tables_comparison import (
        CLUSTER_COLUMNS,
        cluster_comparison_table,
        paper_cluster_table,
    )

    first = rows[0].tables[0]
    ready = prepare(rows, columns_of(part, rows, 1), **asdict(part.rows(first)))
    found = compare_clusterings(
        ready.features,
        ready.labels,
        controls=ready.controls,
        method=choices.method,
        resample_count=choices.resamples,
        seed=choices.seed,
        memory=memory,
    )
    differs = part.differs(str(first.origin.get("layout", "unknown data")), found.n_rows)
    shown = [
        paper_cluster_table(part.name, spec.number, part.paper, found, differs),
        cluster_comparison_table(found),
        verdict_table(found.rows, CLUSTER_COLUMNS, f"{part.name}: above the strongest control?"),
    ]
    told = {"n_dropped_before": ready.n_dropped, "differs": differs, "paper": part.paper}
    return shown, {**found.numbers(), **told}


def run_linear(
    spec: "TableSpec", part: "Part", rows: "list[FeatureRow]", choices: Choices, memory: "Memory"
) -> "tuple[list[ScoreTable], Mapping[str, Any]]":
    """One question of a linear table."""
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.linear_compare import compare_linear
    from derender.evaluation.linear_task import choose_rows, task_of
    from derender.report.tables_comparison import linear_tables, paper_linear_table

    first = rows[0].tables[0]
    ready = prepare(rows, columns_of(part, rows, 2))
    draws = tuple(range(choices.seed, choices.seed + choices.seeds))
    task = task_of(ready.labels)
    split = choose_rows(task, ready.files, choices.counts, draws, partition=ready.partition)
    with progress_bar("probing", "probes") as report:
        found = compare_linear(
            ready.features,
            task,
            split,
            draws,
            controls=ready.controls,
            finetuned=choices.finetuned and choices.finetuned(ready, task, split, draws),
            resample_count=choices.resamples,
            memory=memory,
            progress=report,
        )
    differs = part.differs(str(first.origin.get("layout", "unknown data")), len(ready.files))
    shown = [paper_linear_table(part.name, spec.number, part.paper, found, differs), *linear_tables(found)]
    return shown, {**found.numbers(), "differs": differs, "paper": part.paper}


Runner = Callable[..., "tuple[list[ScoreTable], Mapping[str, Any]]"]
RUNNERS: dict[str, Runner] = {"cluster": run_cluster, "linear": run_linear}
"""By kind of table; ``segment`` takes models instead of features."""
