"""`derender compare`: one of the paper's tables for the features and models a user has, beside the paper's
numbers.

What a table is stands as data in ``evaluation/tables.py``. A kind of table is a runner in ``RUNNERS``: it
takes the table's part, the rows and the options and gives the tables to show and the numbers for JSON.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import feature_rows, options
from derender.cli.console import bar, say, show_scores, write_json

if TYPE_CHECKING:
    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.memory import Memory
    from derender.evaluation.tables import Part, TableSpec
    from derender.report.score_table import ScoreTable

Table = Annotated[
    str, typer.Option("--table", help="clustering, identity, emotion, linear or cars: the paper's tables.")
]
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
class Choices:
    """How a table is made, whatever its kind."""

    seeds: int
    counts: tuple[int, ...]
    method: str
    resamples: int
    seed: int


def register(app: typer.Typer) -> None:
    app.command(
        "compare",
        epilog="Example: derender compare --table linear --model faces=runs/faces --data celeba.zip",
    )(compare)


def compare(
    table: Table,
    features: Named = None,
    model: Models = None,
    data: Data = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    factors: feature_rows.Factors = "geometry,albedo",
    method: Annotated[str, typer.Option("--method", help="ward (the paper's), finch or k-means.")] = "ward",
    counts: Annotated[
        str, typer.Option("--counts", help="Labelled rows to learn from, with commas between.")
    ] = "100,500,1000",
    seeds: Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Draws of training rows.")] = 5,
    untrained_seeds: feature_rows.UntrainedSeeds = 3,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
    json_file: options.Json = None,
    markdown: feature_rows.Markdown = None,
    latex: feature_rows.Latex = None,
    force: options.Force = False,
) -> None:
    """Several models and features under one protocol, beside the paper's own numbers."""
    from derender.evaluation.feature_rows import check_rows
    from derender.evaluation.tables import table_named

    spec, choices = (
        table_named(table),
        Choices(seeds, feature_rows.whole_numbers(counts, "--counts"), method, resamples, seed),
    )
    if spec.kind not in RUNNERS:
        raise ValueError(f"table {table!r} has no command yet; there is {', '.join(RUNNERS)}")
    feature_rows.refuse_to_replace(force, markdown, latex)
    if not features and not model:
        raise ValueError("give --features NAME=FILE.parquet, or --model NAME=MODEL with --data D")
    if model and data is None:
        raise ValueError("--model needs --data: the pictures to embed")
    memory = feature_rows.memory_in(cache)
    pictures = None if data is None else feature_rows.Pictures(data, dataset, limit)
    chosen = feature_rows.factors_of(factors)
    rows = feature_rows.rows_from_tables(feature_rows.named_paths(features or (), "--features"), chosen)
    if model and pictures is not None:
        named = feature_rows.named_paths(model, "--model")
        rows += feature_rows.rows_from_models(named, pictures, chosen, device, memory)
    check_rows(rows)
    if pictures is None:
        say("without --data there are no pixels, PCA and untrained encoder to compare with")
    else:
        settings = feature_rows.architecture(rows)
        size = 64 if settings is None else settings.network.image_size
        same = feature_rows.aligned(pictures.at(size), rows[0].tables[0].files)
        taken = range(seed, seed + untrained_seeds)
        rows += feature_rows.control_rows(same, settings, chosen, taken, device, memory)

    parts = [part for part in spec.parts if part.columns(rows[0].tables[0])]
    if not parts:
        wanted = " or ".join(", ".join(part.labels) for part in spec.parts)
        have = ", ".join(rows[0].tables[0].labels) or "none"
        raise ValueError(
            f"table {table!r} needs labels ({wanted}), the features have {have}: embed other data"
        )
    tables: list[ScoreTable] = []
    values: dict[str, Any] = {}
    for part in parts:
        shown, values[part.name] = RUNNERS[spec.kind](spec, part, rows, choices, memory)
        tables += shown
    for one in tables:
        show_scores(one, json_file)
    say(f"{memory.made} results computed, {memory.recalled} found")
    write_json(json_file, {"table": spec.name, "number": spec.number, "parts": values})
    feature_rows.write_tables(tables, markdown, latex)


def run_cluster(
    spec: "TableSpec", part: "Part", rows: "list[FeatureRow]", choices: Choices, memory: "Memory"
) -> "tuple[list[ScoreTable], Mapping[str, Any]]":
    """One question of a clustering table."""
    from derender.evaluation.clustering_compare import compare_clusterings
    from derender.evaluation.feature_rows import prepare
    from derender.report.tables_comparison import (
        CLUSTER_COLUMNS,
        cluster_comparison_table,
        paper_cluster_table,
        verdict_table,
    )

    first = rows[0].tables[0]
    columns = part.columns(first)
    tracks = part.name == "identity" and "track" in first.labels
    ready = prepare(
        rows,
        columns,
        mean_by=(*columns, "track") if tracks else (),
        min_count=1 if tracks or part.max_count is None else part.min_count,
        max_count=None if tracks else part.max_count,
    )
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
    return shown, {**found.numbers(), "differs": differs, "paper": part.paper}


def run_linear(
    spec: "TableSpec", part: "Part", rows: "list[FeatureRow]", choices: Choices, memory: "Memory"
) -> "tuple[list[ScoreTable], Mapping[str, Any]]":
    """One question of a linear table."""
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.linear_compare import compare_linear
    from derender.evaluation.linear_task import choose_rows, task_of
    from derender.report.tables_comparison import (
        LINEAR_COLUMNS,
        linear_part_table,
        paper_linear_table,
        verdict_table,
    )

    first = rows[0].tables[0]
    ready = prepare(rows, part.columns(first))
    task = task_of(ready.labels)
    draws = tuple(range(choices.seed, choices.seed + choices.seeds))
    split = choose_rows(task, ready.files, choices.counts, draws, partition=ready.partition)
    with bar("probing", "probes") as report:
        found = compare_linear(
            ready.features,
            task,
            split,
            draws,
            controls=ready.controls,
            resample_count=choices.resamples,
            memory=memory,
            progress=report,
        )
    differs = part.differs(str(first.origin.get("layout", "unknown data")), len(task))
    shown = [paper_linear_table(part.name, spec.number, part.paper, found, differs)]
    for one in found.parts:
        caption = f"{one.count:,} labelled rows, {one.head}: above the strongest control?"
        shown += [linear_part_table(found, one), verdict_table(one.rows, LINEAR_COLUMNS, caption)]
    return shown, {**found.numbers(), "differs": differs, "paper": part.paper}


Runner = Callable[..., "tuple[list[ScoreTable], Mapping[str, Any]]"]
RUNNERS: dict[str, Runner] = {"cluster": run_cluster, "linear": run_linear}
