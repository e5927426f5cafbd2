"""`derender refine` and `unet`: copies of a model whose encoders learn from its own scenes."""

from typing import Annotated

from typer import Option

from derender.cli.console import notice
from derender.cli.copies import copied
from derender.cli.gathered import command
from derender.cli.options import OutModel, Output, PartOfImages, Seed, TrainedModel

REFINING = (
    "images (how many are seen), batch_size, learning_rate, fitted (images), fit_steps, worst, rendered, "
    "exchanged, picture_weight, reframed (share shown in other crops, as reframe.farther=1.9), strange; the "
    "size of perturbations, as perturb.light_deg; for features those of derender whiten."
)
UNETS = (
    "images (how many are seen), batch_size, learning_rate, weight_decay, code_weight, unet_width, precision "
    "(32-true or bf16-mixed)."
)
Refining = Annotated[list[str] | None, Option("--set", metavar="KEY=VALUE", help=REFINING)]
UNets = Annotated[list[str] | None, Option("--set", metavar="KEY=VALUE", help=UNETS)]


@command("refine", "refine photos/ --model runs/mine --part train --out refined")
def refine(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Refining = None,
    seed: Seed = 0,
) -> None:  # fmt: skip
    """Write a copy of a model that predicts at once the scenes that test-time optimisation finds slowly.

    Scenes are fitted to these images once, without labels; then the encoders learn to predict them, from the
    images and from renderings of the fitted scenes under other lighting and viewpoints (knowledge
    distillation). Every tenth image is held out: errors are measured on those.
    """
    from derender import learn

    scores = copied(learn.refine, "refining", images, model, out, output, settings, seed=seed)
    errors = scores["errors"]
    notice(
        f"{scores['held_out']} held-out images: reconstructed with an error of {errors['now']:.4f}, before "
        f"{errors['before']:.4f}, fitted {errors['fitted']:.4f}"
    )
    for name, gap in scores["gaps"].items():
        away = f"{gap['now']:.2f} mean deviations away from fitted scenes"
        notice(f"{name}: {away}, before {gap['before']:.2f}")


@command("unet", "unet photos/ --model faces-64 --out faces-unet")
def unet(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: UNets = None,
    seed: Seed = 0,
) -> None:  # fmt: skip
    """Write a copy of a model with U-Net encoders that learn its scenes pixel by pixel, without labels.

    The encoders of geometry and albedo are exchanged; light, camera, decoders and confidence stay. The copy
    is for derender evaluate segment, and decomposes images, too.
    """
    from derender import learn

    scores = copied(learn.unet, "distilling", images, model, out, output, settings, seed=seed)
    errors = scores["errors"]
    notice(
        f"mean errors against {model.model}: place {errors['place']:.2f} pixels, depth {errors['depth']:.1%} "
        f"of its range, albedo {errors['albedo']:.3f}; reconstruction {errors['reconstruction']:.4f}, before "
        f"{errors['reconstruction before']:.4f}"
    )
