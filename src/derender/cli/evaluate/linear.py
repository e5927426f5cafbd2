"""`derender evaluate linear`: how much does a linear head learn from features, given few labels?"""

from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar


def linear(
    images: options.DataOptions,
    subject: scoring.ScoredSubject,
    labels: scoring.Labels,
    computed: scoring.Computed,
    published: scoring.Published,
    counts: scoring.Counts = "100,500,1000",
    heads: Annotated[
        str,
        typer.Option(
            help="Probes: linear (the paper's), centred (the same on features of mean 0), logistic, k-NN."
        ),
    ] = "linear,logistic,k-NN",
    seeds: Annotated[int, scoring.number(help="Number of random training subsets.")] = 5,
    test_fraction: Annotated[float, scoring.share(help="Share of the rows that is tested.")] = 0.5,
    groups: scoring.Groups = None,
    finetune: Annotated[
        bool, typer.Option("--finetune", help="Also train the encoders with the head (slow without a GPU).")
    ] = False,
    epochs: Annotated[int, scoring.number(help="Epochs of the paper's head.")] = 100,
    untrained_seeds: scoring.UntrainedSeeds = 5,
) -> None:
    """How much does a linear head learn from features, given 100, 500 or 1,000 labels? 1 is best."""
    from derender import evaluation

    published.check()
    address = images.optional_address
    with progress_bar("scoring") as progress:
        scores = evaluation.linear(
            subject.source(address), images=address, **images.how, **subject.how, **vars(labels),
            **vars(computed), counts=scoring.numbers_of(counts, "--counts"),
            heads=scoring.names_of(heads) or (), seeds=seeds, test_fraction=test_fraction, groups=groups,
            finetune=finetune, epochs=epochs, untrained_seeds=untrained_seeds, progress=progress,
        )  # fmt: skip
    published.publish(scores)
