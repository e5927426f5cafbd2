"""`derender compare`: one of the paper's tables for other features, or by plan many methods trained here."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar
from derender.cli.evaluate.segment import Masks
from derender.cli.gathered import gathered
from derender.cli.plan import Planned, by_plan

if TYPE_CHECKING:
    from derender.evaluation import Scores

Table = Annotated[
    str | None, typer.Option("--table", help="Clustering, identity, emotion, linear, segmentation or cars.")
]
Features = Annotated[
    list[str] | None,
    typer.Option(
        "--features", "-f", metavar="NAME=FILE.parquet",
        help="Table made by derender embed; a name given again is another seed.",
    ),
]  # fmt: skip
Models = Annotated[
    list[str] | None,
    typer.Option("--model", "-m", help=f"Model, with IMAGES: {options.MODELS}", metavar="NAME=MODEL"),
]
Counts = Annotated[str, typer.Option("--counts", help="Numbers of labelled rows, with commas between.")]
Seeds = Annotated[
    int, typer.Option("--seeds", min=1, metavar="N", help="Number of training subsets; of runs of each net.")
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Epochs of segmentation nets.")]
Finetune = Annotated[
    bool, typer.Option("--finetune", help="With --table linear: also train the models' encoders.")
]


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables."""

    table: Table = None
    features: Features = None
    model: Models = None
    factors: scoring.Factors = "geometry,albedo"
    masks: Masks = None
    method: scoring.Method = "ward"
    counts: Counts = "100,500,1000"
    seeds: Seeds = 5
    epochs: Epochs = 20
    finetune: Finetune = False
    untrained_seeds: scoring.UntrainedSeeds = 3


def register(app: typer.Typer) -> None:
    app.command(
        "compare", epilog="Example: derender compare celeba.zip --table linear --model faces=runs/faces"
    )(compare)


@gathered
def compare(
    images: options.DataOptions,
    paper: PaperTable,
    computed: scoring.Computed,
    published: scoring.Published,
    planned: Planned,
) -> None:
    """Several models and features under one protocol, beside the paper's own numbers.

    With --plan: many methods, trained here on the same images, on many data sets and protocols.
    """
    if planned.plan is not None:
        rest = (images, paper, replace(computed, device="auto"), replace(published, json_file=None))
        if rest != (options.DataOptions(), PaperTable(), scoring.Computed(), scoring.Published()):
            raise ValueError(
                "--plan says what is compared and how, and --out gets every form of its tables: beside them "
                "go --workers, --minutes, --dry-run, --device and --json alone"
            )
        by_plan(planned, computed.device, published.json_file)
        return
    if planned != Planned():
        raise ValueError("--out, --workers, --minutes and --dry-run go with --plan FILE")
    if paper.table is None:
        raise ValueError("give --table NAME with --model or --features, or --plan FILE with --out DIR")
    published.check()
    published.publish(paper_table(paper, images, computed))


def paper_table(paper: PaperTable, images: options.DataOptions, computed: scoring.Computed) -> "Scores":
    """The table that was requested."""
    from derender import evaluation
    from derender.evaluation.paper_tables import TABLES
    from derender.features import FeatureTable

    if paper.table == "segmentation" and paper.features:
        raise ValueError("table 'segmentation' trains a model's encoders, features do not do: give --model")
    if paper.table != "segmentation" and paper.masks is not None:
        raise ValueError(f"--masks goes with --table segmentation, not with {paper.table}")
    tables = scoring.named_paths(paper.features or (), "--features")
    models = scoring.named_paths(paper.model or (), "--model")
    if not tables and not models and paper.table in TABLES:
        raise ValueError("give --features NAME=FILE.parquet, or --model NAME=MODEL with IMAGES")
    sources = {name: [FeatureTable.read(path) for path in paths] for name, paths in tables.items()}
    with progress_bar("scoring") as progress:
        return evaluation.compare(
            str(paper.table), {**sources, **models}, images.optional_address, **images.how, **vars(computed),
            factors=scoring.names_of(paper.factors), masks=paper.masks, epochs=paper.epochs,
            method=paper.method, counts=scoring.numbers_of(paper.counts, "--counts"), seeds=paper.seeds,
            finetune=paper.finetune, untrained_seeds=paper.untrained_seeds, progress=progress,
        )  # fmt: skip
