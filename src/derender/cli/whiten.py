"""`derender whiten`: a model's features, estimated on the images they will be used on."""

from typing import Annotated

import typer

from derender.cli.console import notice, progress_bar, report_images
from derender.cli.gathered import gathered
from derender.cli.options import OutModel, Output, PartOfImages, Seed, TrainedModel

Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE",
        help="images, views, spatial, mirrored, directions, shrinkage, evenness, vectors, vector_power of "
        "whitening; examples, coordinates, steps, prior, tolerance, weight of fitting; the size of "
        "perturbations, as perturb.light_deg.",
    ),
]  # fmt: skip
MeanOnly = Annotated[
    bool,
    typer.Option(
        "--mean-only",
        help="Keep the model's own directions; take only the mean of its features from these images.",
    ),
]


def register(app: typer.Typer) -> None:
    app.command("whiten", epilog="Example: derender whiten photos/ --model rendered-faces-64 --out mine")(
        whiten
    )


@gathered
def whiten(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Changes = None,
    mean_only: MeanOnly = False, seed: Seed = 0,
) -> None:  # fmt: skip
    """Write a copy of a model whose features move as little as possible with other factors.

    They are estimated on these images, without labels. Weights and scenes stay as they are. Training ends
    with this by itself. With --set steps=60 features also hold scenes optimised for each image by rendering.
    """
    from derender import learn

    output.refuse_existing(out)
    with progress_bar("re-rendering") as report:
        made = learn.whiten(
            model.model, images.address, out=out, settings=settings or (), mean_only=mean_only,
            device=model.device, overwrite=output.force, **images.how, seed=seed, on_images=report_images,
            progress=report,
        )  # fmt: skip
    for name, ratios in made.scores["between_over_within"].items():
        clear = sum(ratio > 1 for ratio in ratios)
        notice(
            f"{name}: {len(ratios)} directions kept; in {clear} images differ more than one does where other "
            "factors change"
        )
    output.result(f"model {made.folder}")
    output.write(made.values())
