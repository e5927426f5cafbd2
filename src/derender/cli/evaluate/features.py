"""`derender evaluate cluster` and `linear`: features by a label that training never saw."""

from typing import Annotated

import typer

from derender.cli import options, scoring

MEAN_BY = "Average first over rows that share this label; may be repeated."
MeanBy = Annotated[list[str] | None, typer.Option("--mean-by", help=MEAN_BY)]
Clusters = Annotated[int | None, scoring.number(help="Number of clusters; default: one for each class.")]
HEADS = "Probes: linear (the paper's), centred (the same on features of mean 0), logistic, k-NN."
FINETUNE = "Also train the encoders with the head (slow without a GPU)."
Heads = Annotated[str, typer.Option(help=HEADS)]
Seeds = Annotated[int, scoring.number(help="Number of random training subsets.")]
Tested = Annotated[float, scoring.share(help="Share of the rows that is tested.")]
Finetune = Annotated[bool, typer.Option("--finetune", help=FINETUNE)]
Epochs = Annotated[int, scoring.number(help="Epochs of the paper's head.")]


def cluster(
    images: options.DataOptions, subject: scoring.ScoredSubject, labels: scoring.Labels,
    computed: scoring.Computed, published: scoring.Published, method: scoring.Method = "ward",
    mean_by: MeanBy = None, clusters: Clusters = None, untrained_seeds: scoring.UntrainedSeeds = 3,
) -> None:  # fmt: skip
    """Do features group images by a label that training never saw? 1 is best."""
    own = {"method": method, "clusters": clusters, "mean_by": mean_by or ()}
    own |= {"untrained_seeds": untrained_seeds}
    scoring.score("cluster", published, images, subject, **vars(labels), **vars(computed), **own)


def linear(
    images: options.DataOptions, subject: scoring.ScoredSubject, labels: scoring.Labels,
    computed: scoring.Computed, published: scoring.Published, counts: scoring.Counts = "100,500,1000",
    heads: Heads = "linear,logistic,k-NN", seeds: Seeds = 5, test_fraction: Tested = 0.5,
    groups: scoring.Groups = None, finetune: Finetune = False, epochs: Epochs = 100,
    untrained_seeds: scoring.UntrainedSeeds = 5,
) -> None:  # fmt: skip
    """How much does a linear head learn from features, given 100, 500 or 1,000 labels? 1 is best."""
    own = {"counts": scoring.numbers_of(counts, "--counts"), "heads": scoring.names_of(heads) or ()}
    own |= {"seeds": seeds, "test_fraction": test_fraction, "groups": groups}
    own |= {"finetune": finetune, "epochs": epochs, "untrained_seeds": untrained_seeds}
    scoring.score("linear", published, images, subject, **vars(labels), **vars(computed), **own)
