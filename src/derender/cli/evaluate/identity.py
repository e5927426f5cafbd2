"""`derender evaluate identify` and `verify`: are faces recognised in other light and photographs?"""

from typing import Annotated

import typer

from derender.cli import options, scoring

LABEL = "Label column of the people."
Label = Annotated[str, typer.Option("--label", "-l", help=LABEL)]
BY = "Column of angles that groups the probes; default: light_deg, if there."
By = Annotated[str | None, typer.Option(metavar="COLUMN", help=BY)]
Bins = Annotated[str, typer.Option(help="Upper edges of the groups in degrees, with commas between.")]
GALLERY = "Images of the gallery; default: one a person, that of the smallest angle."
Gallery = Annotated[str | None, typer.Option(metavar="COLUMN=VALUE", help=GALLERY)]
CENTRED = "Subtract the mean of the gallery before the cosine."
Centred = Annotated[bool, typer.Option("--centred/--no-centred", help=CENTRED)]
Within = Annotated[float, typer.Option(metavar="DEG", help="Also cluster images up to this angle.")]
Pairs = Annotated[
    str, typer.Option("--pairs", metavar="FILE", help="Pairs in the format of LFW's pairs.txt.")
]


def identify(
    images: options.DataOptions, subject: scoring.ScoredSubject, computed: scoring.Computed,
    published: scoring.Published, label: Label = "identity", by: By = None, bins: Bins = "12,25,50,77",
    gallery: Gallery = None, centred: Centred = True, cluster_within: Within = 50.0,
    untrained_seeds: scoring.UntrainedSeeds = 3,
) -> None:  # fmt: skip
    """Is a person recognised by one image, in any light? Nearest of a gallery by cosine; 1 is best.

    The cropped Extended Yale B needs no options: the gallery is its frontal light, the groups its subsets.
    """
    own = {"label": label, "by": by, "bins": scoring.numbers_of(bins, "--bins"), "gallery": gallery}
    own |= {"centred": centred, "cluster_within": cluster_within, "untrained_seeds": untrained_seeds}
    scoring.score("identify", published, images, subject, **vars(computed), **own)


def verify(
    images: options.DataOptions, subject: scoring.ScoredSubject, computed: scoring.Computed,
    published: scoring.Published, pairs: Pairs, untrained_seeds: scoring.UntrainedSeeds = 3,
) -> None:  # fmt: skip
    """Do two photographs show one person? Accuracy over the folds of LFW's protocol, and AUC; 1 is best."""
    own = {"pairs": pairs, "half": images.half, "untrained_seeds": untrained_seeds}
    scoring.score("verify", published, images, subject, **vars(computed), **own)
