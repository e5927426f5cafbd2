"""`derender compare`: one of the paper's tables for the features and models a user has, beside the paper's
numbers.

What a table is stands as data in ``evaluation/tables.py``. A table of features has a runner in ``RUNNERS``,
which takes the table's part, the rows and the options and gives the tables to show and the numbers for JSON.
Segmentation trains nets and takes models alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import bar, say
from derender.cli.evaluate.segment import Masks, MaskSource, segmented
from derender.cli.gathered import gathered

if TYPE_CHECKING:
    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.memory import Memory
    from derender.evaluation.tables import Part, TableSpec
    from derender.report.score_table import ScoreTable

PAPER_VARIANTS = "joint,geometry,albedo,joint-frozen,random"

Table = Annotated[
    str | None,
    typer.Option("--table", help="clustering, identity, emotion, linear, segmentation or cars: the paper's."),
]
PANEL = "Many methods on many data sets"
PlanFile = Annotated[
    Path | None,
    typer.Option(
        "--plan", help="Train, embed and score what this YAML or TOML file says.", metavar="FILE",
        rich_help_panel=PANEL,
    ),
]  # fmt: skip
PlanOut = Annotated[
    Path | None,
    typer.Option(
        "--out", "-o", help="Of --plan: folder for runs, tables and pictures; the same goes on with it.",
        metavar="DIR", rich_help_panel=PANEL,
    ),
]  # fmt: skip
Workers = Annotated[
    int,
    typer.Option("--workers", min=1, help="Of --plan: jobs at a time.", metavar="N", rich_help_panel=PANEL),
]
Minutes = Annotated[
    float | None,
    typer.Option(
        "--minutes", min=0, help="Of --plan: stop then, and score what is there.", metavar="M",
        rich_help_panel=PANEL,
    ),
]  # fmt: skip
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Of --plan: say what is to be done, and stop.", rich_help_panel=PANEL),
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
Counts = Annotated[str, typer.Option("--counts", help="Labelled rows to learn from, with commas between.")]
Seeds = Annotated[
    int, typer.Option("--seeds", min=1, metavar="N", help="Draws of training rows; runs of each net.")
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Of segmentation nets.")]


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
class Planned:
    """A comparison by plan."""

    plan: PlanFile = None
    out: PlanOut = None
    workers: Workers = 1
    minutes: Minutes = None
    dry_run: DryRun = False


@dataclass(frozen=True)
class Choices:
    """How a table is made, whatever its kind."""

    seeds: int
    counts: tuple[int, ...]
    method: str
    epochs: int
    resamples: int
    seed: int


UNASKED = (None, "ward", "100,500,1000", 5, 20, 3, scoring.Computed())
"""The command's own options where nobody gave them."""


def register(app: typer.Typer) -> None:
    app.command(
        "compare",
        epilog="Example: derender compare --table linear --model faces=runs/faces --data celeba.zip",
    )(compare)


@gathered
def compare(
    given: Given,
    computed: scoring.Computed,
    published: scoring.Published,
    planned: Planned,
    table: Table = None,
    method: scoring.Method = "ward",
    counts: Counts = "100,500,1000",
    seeds: Seeds = 5,
    epochs: Epochs = 20,
    untrained_seeds: feature_rows.UntrainedSeeds = 3,
) -> None:
    """Several models and features under one protocol, beside the paper's own numbers.

    With --plan: many methods, trained here on the same pictures, on many data sets and protocols.
    """
    if planned.plan is not None:
        from derender.cli.plan.command import by_plan

        own = replace(given, features=given.features or None, model=given.model or None)
        rest = (table, method, counts, seeds, epochs, untrained_seeds, replace(computed, device="auto"))
        if (own, replace(published, json_file=None), rest) != (Given(), scoring.Published(), UNASKED):
            raise ValueError(
                "--plan says what is compared and how, and --out gets every form of its tables: beside them "
                "go --workers, --minutes, --dry-run, --device and --json alone"
            )
        by_plan(
            planned.plan,
            planned.out,
            workers=planned.workers,
            minutes=planned.minutes,
            device=computed.device,
            dry_run=planned.dry_run,
            json_file=published.json_file,
        )
        return
    if planned != Planned():
        raise ValueError("--out, --workers, --minutes and --dry-run go with --plan FILE")
    if table is None:
        raise ValueError("give --table NAME with --model or --features, or --plan FILE with --out DIR")
    from derender.evaluation.tables import table_named

    spec = table_named(table)
    numbers = feature_rows.whole_numbers(counts, "--counts")
    choices = Choices(seeds, numbers, method, epochs, computed.resamples, computed.seed)
    published.check()
    if not given.features and not given.model:
        raise ValueError("give --features NAME=FILE.parquet, or --model NAME=MODEL with --data D")
    if given.model and given.data is None:
        raise ValueError("--model needs --data: the pictures to embed")
    memory = feature_rows.memory_in(computed.cache)
    if spec.kind == "segment":
        tables, values = run_segment(given, choices, computed.device, memory)
    else:
        if given.masks is not None:
            raise ValueError(f"--masks goes with --table segmentation, not with {table}")
        rows = gather_rows(given, computed, untrained_seeds, memory)
        tables, values = run_parts(spec, rows, choices, memory)
    told = {"table": spec.name, "number": spec.number, "parts": values}
    published.show(tables, told, [scoring.remembered(memory)])


def gather_rows(
    given: Given, computed: scoring.Computed, untrained_seeds: int, memory: "Memory"
) -> "list[FeatureRow]":
    """Features from tables and models, then the controls that the pictures give."""
    from derender.evaluation.feature_rows import check_rows

    pictures = None if given.data is None else feature_rows.Pictures(given.data, given.dataset, given.limit)
    chosen = feature_rows.factors_of(given.factors)
    named = feature_rows.named_paths(given.features or (), "--features")
    rows = feature_rows.rows_from_tables(named, chosen)
    if given.model and pictures is not None:
        models = feature_rows.named_paths(given.model, "--model")
        rows += feature_rows.rows_from_models(models, pictures, chosen, computed.device, memory)
    check_rows(rows)
    if pictures is None:
        say("without --data there are no pixels, PCA and untrained encoder to compare with")
        return rows
    settings = feature_rows.architecture(rows)
    size = 64 if settings is None else settings.network.image_size
    same = feature_rows.aligned(pictures.at(size), rows[0].tables[0].files)
    taken = computed.from_seed(untrained_seeds)
    return [*rows, *feature_rows.control_rows(same, settings, chosen, taken, computed.device, memory)]


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
    from derender.report.tables_comparison import (
        CLUSTER_COLUMNS,
        cluster_comparison_table,
        paper_cluster_table,
        verdict_table,
    )

    first = rows[0].tables[0]
    ready = prepare(rows, part.columns(first), **asdict(part.rows(first)))
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
    from derender.evaluation.linear_compare import compare_prepared
    from derender.report.tables_comparison import linear_tables, paper_linear_table

    first = rows[0].tables[0]
    ready = prepare(rows, part.columns(first))
    draws = tuple(range(choices.seed, choices.seed + choices.seeds))
    with bar("probing", "probes") as report:
        found = compare_prepared(
            ready,
            choices.counts,
            draws,
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
