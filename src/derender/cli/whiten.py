"""`derender whiten`: a model's features, estimated on the images they will be used on."""

from typing import Annotated

import typer

from derender.cli.console import notice
from derender.cli.copies import changes, copied
from derender.cli.gathered import command
from derender.cli.options import OutModel, Output, PartOfImages, Seed, TrainedModel

SETTINGS = (
    "images, views, spatial, mirrored, directions, shrinkage, evenness, vectors, vector_power of whitening; "
    "examples, coordinates, steps, prior, tolerance, weight of fitting; the size of perturbations, as "
    "perturb.light_deg."
)
Changes = Annotated[list[str] | None, changes(SETTINGS)]
MEAN_ONLY = "Keep the model's own directions; take only the mean of its features from these images."
MeanOnly = Annotated[bool, typer.Option("--mean-only", help=MEAN_ONLY)]


@command("whiten", "whiten photos/ --model rendered-faces-64 --out mine")
def whiten(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Changes = None,
    mean_only: MeanOnly = False, seed: Seed = 0,
) -> None:  # fmt: skip
    """Write a copy of a model whose features move as little as possible with other factors.

    They are estimated on these images, without labels. Weights and scenes stay as they are. Training ends
    with this by itself. With --set steps=60 features also hold scenes optimised for each image by rendering.
    """
    from derender import learn

    how = {"mean_only": mean_only, "seed": seed}
    scores = copied(learn.whiten, "re-rendering", images, model, out, output, settings, **how)
    for name, ratios in scores["between_over_within"].items():
        clear = sum(ratio > 1 for ratio in ratios)
        notice(
            f"{name}: {len(ratios)} directions kept; in {clear} images differ more than one does where other "
            "factors change"
        )
