"""`derender compare`: one of the paper's tables for other features, or by plan many methods trained here."""

from dataclasses import dataclass, replace
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar
from derender.cli.gathered import command
from derender.cli.plan import Planned, by_plan

TABLES = "clustering, identity, emotion, linear, segmentation or cars."
FEATURES = "Table made by derender embed; a name given again is another seed."
Features = typer.Option("--features", "-f", metavar="NAME=FILE.parquet", help=FEATURES)
SUPERVISED = "With --finetune: also a ResNet-18 from fresh weights."
Models = typer.Option("--model", "-m", help=f"Model, with IMAGES: {options.MODELS}", metavar="NAME=MODEL")


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables."""

    table: Annotated[str | None, typer.Option(help=TABLES)] = None
    features: Annotated[list[str] | None, Features] = None
    model: Annotated[list[str] | None, Models] = None
    factors: scoring.Factors = "geometry,albedo"
    masks: scoring.Masks = None
    method: scoring.Method = "ward"
    counts: scoring.Counts = "100,500,1000"
    seeds: Annotated[int, scoring.number(help="Number of training subsets; of runs of each net.")] = 5
    epochs: Annotated[int, scoring.number(help="Epochs of segmentation nets.")] = 20
    finetune: Annotated[bool, typer.Option("--finetune", help="Also train the models' encoders.")] = False
    supervised: Annotated[bool, typer.Option("--supervised", help=SUPERVISED)] = False
    untrained_seeds: scoring.UntrainedSeeds = 3


@command("compare", "compare celeba.zip --table linear --model faces=runs/faces")
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
    rest = (images, paper, replace(computed, device="auto"), replace(published, json_file=None))
    if planned.plan is not None:
        if rest != (options.DataOptions(), PaperTable(), scoring.Computed(), scoring.Published()):
            raise ValueError(
                "beside --plan go --out, --workers, --minutes, --dry-run, --device, --json alone"
            )
        by_plan(planned, computed.device, published.json_file)
        return
    if planned != Planned():
        raise ValueError("--out, --workers, --minutes and --dry-run go with --plan FILE")
    if paper.table is None:
        raise ValueError("give --table NAME with --model or --features, or --plan FILE with --out DIR")
    published.check()
    from derender import evaluation
    from derender.features import FeatureTable

    tables = scoring.named_paths(paper.features or (), "--features")
    models = scoring.named_paths(paper.model or (), "--model")
    read = {name: list(map(FeatureTable.read, paths)) for name, paths in tables.items()}
    with progress_bar("scoring") as progress:
        scores = evaluation.compare(
            paper.table, {**read, **models}, images.optional_address, **images.how, **vars(computed),
            factors=scoring.names_of(paper.factors), masks=paper.masks, epochs=paper.epochs,
            method=paper.method, counts=scoring.numbers_of(paper.counts, "--counts"), seeds=paper.seeds,
            finetune=paper.finetune, supervised=paper.supervised, untrained_seeds=paper.untrained_seeds,
            progress=progress,
        )  # fmt: skip
    published.publish(scores)
