"""`derender evaluate cluster`, `linear`, `identify` and `verify`: features by labels training never saw."""

from derender.cli import scoring
from derender.cli.options import DataOptions, command, option
from derender.cli.scoring import Computed, Labels, Published, ScoredSubject, UntrainedSeeds

MEAN_BY = "Average first over rows that share this label; may be repeated."
HEADS = "Probes: linear (the paper's), centred (the same on features of mean 0), logistic, k-NN."
BY = "Column of angles that groups the probes; default: light_deg, if there."
GALLERY = "Images of the gallery; default: one a person, that of the smallest angle."
FINETUNE = "Also train the encoders with the head (slow without a GPU)."


@command("cluster", "evaluate cluster lfw.zip --model faces-64 --label identity", scoring.evaluate)
def cluster(
    images: DataOptions, subject: ScoredSubject, labels: Labels, computed: Computed, published: Published,
    method: scoring.Method = "ward", mean_by: list[str] | None = option(None, MEAN_BY),
    clusters: int | None = scoring.number(None, "Number of clusters; default: one for each class."),
    untrained_seeds: UntrainedSeeds = 3,
) -> None:  # fmt: skip
    """Do features group images by a label that training never saw? 1 is best."""
    own = {"method": method, "clusters": clusters, "mean_by": mean_by or ()}
    own |= {"untrained_seeds": untrained_seeds}
    subject.score("cluster", images, published, **vars(labels), **vars(computed), **own)


@command("linear", "evaluate linear celeba.zip --model faces-64 --attributes", scoring.evaluate)
def linear(
    images: DataOptions, subject: ScoredSubject, labels: Labels, computed: Computed, published: Published,
    counts: scoring.Counts = "100,500,1000", heads: str = option("linear,logistic,k-NN", HEADS),
    seeds: int = scoring.number(5, "Number of random training subsets."),
    test_fraction: float = scoring.share(0.5, "Share of the rows that is tested."),
    groups: scoring.Groups = None, finetune: bool = option(False, FINETUNE, "--finetune"),
    epochs: int = scoring.number(100, "Epochs of the paper's head."),
    untrained_seeds: UntrainedSeeds = 5,
) -> None:  # fmt: skip
    """How much does a linear head learn from features, given 100, 500 or 1,000 labels? 1 is best."""
    own = {"counts": scoring.numbers_of(counts, "--counts"), "heads": scoring.names_of(heads) or ()}
    own |= {"seeds": seeds, "test_fraction": test_fraction, "groups": groups}
    own |= {"finetune": finetune, "epochs": epochs, "untrained_seeds": untrained_seeds}
    subject.score("linear", images, published, **vars(labels), **vars(computed), **own)


@command("identify", "evaluate identify CroppedYale.zip --model faces-64", scoring.evaluate)
def identify(
    images: DataOptions, subject: ScoredSubject, computed: Computed, published: Published,
    label: str = option("identity", "Label column of the people.", "--label", "-l"),
    by: str | None = option(None, BY, metavar="COLUMN"),
    bins: str = option("12,25,50,77", "Upper edges of the groups in degrees, with commas between."),
    gallery: str | None = option(None, GALLERY, metavar="COLUMN=VALUE"),
    centred: bool = option(True, "Subtract the mean of the gallery before the cosine."),
    cluster_within: float = option(50.0, "Also cluster images up to this angle.", metavar="DEG"),
    untrained_seeds: UntrainedSeeds = 3,
) -> None:  # fmt: skip
    """Is a person recognised by one image, in any light? Nearest of a gallery by cosine; 1 is best.

    The cropped Extended Yale B needs no options: the gallery is its frontal light, the groups its subsets.
    """
    own = {"label": label, "by": by, "bins": scoring.numbers_of(bins, "--bins"), "gallery": gallery}
    own |= {"centred": centred, "cluster_within": cluster_within, "untrained_seeds": untrained_seeds}
    subject.score("identify", images, published, **vars(computed), **own)


@command("verify", "evaluate verify lfw.zip --model faces-64 --pairs pairs.txt", scoring.evaluate)
def verify(
    images: DataOptions, subject: ScoredSubject, computed: Computed, published: Published,
    pairs: str = option(..., "Pairs in the format of LFW's pairs.txt.", metavar="FILE"),
    untrained_seeds: UntrainedSeeds = 3,
) -> None:  # fmt: skip
    """Do two photographs show one person? Accuracy over the folds of LFW's protocol, and AUC; 1 is best."""
    own = {"pairs": pairs, "half": images.half, "untrained_seeds": untrained_seeds}
    subject.score("verify", images, published, **vars(computed), **own)
