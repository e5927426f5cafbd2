"""`derender evaluate cluster`: do features group images by a label that training never saw?"""

from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar


def cluster(
    images: options.DataOptions,
    subject: scoring.ScoredSubject,
    labels: scoring.Labels,
    computed: scoring.Computed,
    published: scoring.Published,
    method: scoring.Method = "ward",
    mean_by: Annotated[
        list[str] | None,
        typer.Option("--mean-by", help="Average first over rows that share this label; may be repeated."),
    ] = None,
    clusters: Annotated[
        int | None, scoring.number(help="Number of clusters; default: one for each class.")
    ] = None,
    untrained_seeds: scoring.UntrainedSeeds = 3,
) -> None:
    """Do features group images by a label that training never saw? 1 is best."""
    from derender import evaluation

    published.check()
    address = images.optional_address
    with progress_bar("scoring") as progress:
        scores = evaluation.cluster(
            subject.source(address), images=address, **images.how, **subject.how, **vars(labels),
            **vars(computed), method=method, clusters=clusters, mean_by=mean_by or (),
            untrained_seeds=untrained_seeds, progress=progress,
        )  # fmt: skip
    published.publish(scores)
