"""`derender compare`: one of the paper's tables for the features and models a user has, beside the paper's
numbers; or, by plan, many methods trained here.

The tables themselves are made in paper_tables.py and plan/.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import feature_rows, scoring
from derender.cli.console import notice
from derender.cli.gathered import gathered
from derender.cli.paper_tables import Choices, Given, finetuning, run_parts, run_segment

if TYPE_CHECKING:
    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.memory import Memory

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
Counts = Annotated[str, typer.Option("--counts", help="Labelled rows to learn from, with commas between.")]
Seeds = Annotated[
    int, typer.Option("--seeds", min=1, metavar="N", help="Draws of training rows; runs of each net.")
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Of segmentation nets.")]
Finetune = Annotated[
    bool,
    typer.Option("--finetune", help="Of the linear table: also train the models' encoders with the head."),
]


@dataclass(frozen=True)
class Planned:
    """A comparison by plan."""

    plan: PlanFile = None
    out: PlanOut = None
    workers: Workers = 1
    minutes: Minutes = None
    dry_run: DryRun = False


UNASKED = (None, "ward", "100,500,1000", 5, 20, False, 3, scoring.Computed())
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
    finetune: Finetune = False,
    untrained_seeds: feature_rows.UntrainedSeeds = 3,
) -> None:
    """Several models and features under one protocol, beside the paper's own numbers.

    With --plan: many methods, trained here on the same pictures, on many data sets and protocols.
    """
    if planned.plan is not None:
        from derender.cli.plan.command import by_plan

        own = replace(given, features=given.features or None, model=given.model or None)
        own_way = replace(computed, device="auto")
        rest = (table, method, counts, seeds, epochs, finetune, untrained_seeds, own_way)
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
    if finetune and (spec.kind != "linear" or not given.model):
        raise ValueError(
            "--finetune trains the encoders of models: give --table linear with --model and --data"
        )
    memory = feature_rows.memory_in(computed.cache)
    if spec.kind == "segment":
        tables, values = run_segment(given, choices, computed.device, memory)
    else:
        if given.masks is not None:
            raise ValueError(f"--masks goes with --table segmentation, not with {table}")
        pictures = None
        if given.data is not None:
            pictures = feature_rows.Pictures(given.data, given.dataset, given.limit)
        rows = gather_rows(given, pictures, computed, untrained_seeds, memory)
        if finetune and pictures is not None:
            choices = replace(choices, finetuned=finetuning(given, pictures, computed.device, memory))
        tables, values = run_parts(spec, rows, choices, memory)
    told = {"table": spec.name, "number": spec.number, "parts": values}
    notes = [
        f"{name}: {part['n_dropped_before']:,} rows without a label left out before averaging"
        for name, part in values.items()
        if part.get("n_dropped_before")
    ]
    published.show(tables, told, [*notes, scoring.remembered(memory)])


def gather_rows(
    given: Given,
    pictures: "feature_rows.Pictures | None",
    computed: scoring.Computed,
    untrained_seeds: int,
    memory: "Memory",
) -> "list[FeatureRow]":
    """Features from tables and models, then the controls that the pictures give."""
    from derender.evaluation.feature_rows import check_rows

    chosen = feature_rows.factors_of(given.factors)
    named = feature_rows.named_paths(given.features or (), "--features")
    rows = feature_rows.rows_from_tables(named, chosen)
    if given.model and pictures is not None:
        models = feature_rows.named_paths(given.model, "--model")
        rows += feature_rows.rows_from_models(models, pictures, chosen, computed.device, memory)
    check_rows(rows)
    if pictures is None:
        notice("without --data there are no pixels, PCA and untrained encoder to compare with")
        return rows
    settings = feature_rows.architecture(rows)
    size = 64 if settings is None else settings.network.image_size
    same = feature_rows.aligned(pictures.at(size), rows[0].tables[0].files)
    taken = computed.from_seed(untrained_seeds)
    return [*rows, *feature_rows.control_rows(same, settings, chosen, taken, computed.device, memory)]
