"""`derender unet`: a copy of a model with U-Net encoders, for segmentation."""

from typing import Annotated

import typer

from derender.cli.console import notice, progress_bar, report_images
from derender.cli.gathered import gathered
from derender.cli.options import OutModel, Output, PartOfImages, Seed, TrainedModel

Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE",
        help="images (how many are seen), batch_size, learning_rate, weight_decay, code_weight, unet_width, "
        "precision (32-true or bf16-mixed).",
    ),
]  # fmt: skip


def register(app: typer.Typer) -> None:
    app.command("unet", epilog="Example: derender unet photos/ --model faces-64 --out faces-unet")(unet)


@gathered
def unet(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Changes = None,
    seed: Seed = 0,
) -> None:  # fmt: skip
    """Write a copy of a model with U-Net encoders that learn its scenes pixel by pixel, without labels.

    The encoders of geometry and albedo are exchanged; light, camera, decoders and confidence stay. The copy
    is for derender evaluate segment, and decomposes images, too.
    """
    from derender import learn

    output.refuse_existing(out)
    with progress_bar("distilling") as report:
        made = learn.unet(
            model.model, images.address, out=out, settings=settings or (), seed=seed, device=model.device,
            overwrite=output.force, **images.how, on_images=report_images, progress=report,
        )  # fmt: skip
    errors = made.scores["errors"]
    notice(
        f"mean errors against {model.model}: place {errors['place']:.2f} pixels, depth {errors['depth']:.1%} "
        f"of its range, albedo {errors['albedo']:.3f}; reconstruction {errors['reconstruction']:.4f}, before "
        f"{errors['reconstruction before']:.4f}"
    )
    output.result(f"model {made.folder}")
    output.write(made.values())
