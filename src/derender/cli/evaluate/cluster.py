"""`derender evaluate cluster`: do features group images by a label that training never saw?"""

from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar
from derender.cli.gathered import gathered

MeanBy = Annotated[
    list[str] | None,
    typer.Option("--mean-by", help="Average first over rows that share this label; may be repeated."),
]
Clusters = Annotated[
    int | None,
    typer.Option("--clusters", min=1, metavar="N", help="Number of clusters; default: one for each class."),
]


def register(group: typer.Typer) -> None:
    group.command(
        "cluster", epilog="Example: derender evaluate cluster lfw.zip --model faces-64 --label identity"
    )(cluster)


@gathered
def cluster(
    images: options.DataOptions,
    subject: scoring.ScoredSubject,
    labels: scoring.Labels,
    computed: scoring.Computed,
    published: scoring.Published,
    method: scoring.Method = "ward",
    mean_by: MeanBy = None,
    clusters: Clusters = None,
    untrained_seeds: scoring.UntrainedSeeds = 3,
) -> None:
    """Do features group images by a label that training never saw? 1 is best."""
    from derender import evaluation

    published.check()
    address = images.optional_address
    with progress_bar("scoring") as progress:
        scores = evaluation.cluster(
            subject.source(address), images=address, **images.how, **vars(labels), **vars(computed),
            factors=scoring.names_of(subject.factors), whiten_on=subject.whiten_on, method=method,
            clusters=clusters, mean_by=mean_by or (), untrained_seeds=untrained_seeds, progress=progress,
        )  # fmt: skip
    published.publish(scores)
