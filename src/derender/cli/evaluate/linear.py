"""`derender evaluate linear`: how much does a linear head learn from features, given few labels?"""

from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar
from derender.cli.gathered import gathered

Counts = Annotated[
    str, typer.Option("--counts", help="Numbers of labelled rows to learn from, with commas between.")
]
Heads = Annotated[
    str,
    typer.Option(
        "--heads",
        help="Probes: linear (the paper's), centred (the same on features of mean 0), logistic, k-NN.",
    ),
]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Number of random training subsets.")]
TestFraction = Annotated[
    float, typer.Option("--test-fraction", min=0.01, max=0.99, help="Share of the rows that is tested.")
]
Groups = Annotated[
    str | None, typer.Option("--groups", help="Label whose rows stay on one side of the split, as identity.")
]
Finetune = Annotated[
    bool, typer.Option("--finetune", help="Also train the encoders with the head (slow without a GPU).")
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Epochs of the paper's head.")]


def register(group: typer.Typer) -> None:
    group.command(
        "linear", epilog="Example: derender evaluate linear celeba.zip --model faces-64 --attributes"
    )(linear)


@gathered
def linear(
    images: options.DataOptions,
    subject: scoring.ScoredSubject,
    labels: scoring.Labels,
    computed: scoring.Computed,
    published: scoring.Published,
    counts: Counts = "100,500,1000",
    heads: Heads = "linear,logistic,k-NN",
    seeds: Seeds = 5,
    test_fraction: TestFraction = 0.5,
    groups: Groups = None,
    finetune: Finetune = False,
    epochs: Epochs = 100,
    untrained_seeds: scoring.UntrainedSeeds = 5,
) -> None:
    """How much does a linear head learn from features, given 100, 500 or 1,000 labels? 1 is best."""
    from derender import evaluation

    published.check()
    address = images.optional_address
    with progress_bar("scoring") as progress:
        scores = evaluation.linear(
            subject.source(address), images=address, **images.how, **vars(labels), **vars(computed),
            factors=scoring.names_of(subject.factors), whiten_on=subject.whiten_on,
            counts=scoring.numbers_of(counts, "--counts"), heads=scoring.names_of(heads) or (), seeds=seeds,
            test_fraction=test_fraction, groups=groups, finetune=finetune, epochs=epochs,
            untrained_seeds=untrained_seeds, progress=progress,
        )  # fmt: skip
    published.publish(scores)
