"""`derender refine` and `unet`: copies of a model whose encoders learn from its own scenes."""

from derender.cli.console import notice
from derender.cli.copies import copied
from derender.cli.options import OutModel, Output, PartOfImages, Seed, Settings, TrainedModel, command
from derender.cli.runs import DryRun


@command("refine", "refine photos/ --model runs/mine --part train --out refined")
def refine(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Settings = None,
    seed: Seed = 0, dry_run: DryRun = False,
) -> None:  # fmt: skip
    """Write a copy of a model that predicts at once the scenes that test-time optimisation finds slowly.

    Scenes are optimised for these images once, without labels. The encoders then learn to predict them from
    the images and from renderings under other lighting and viewpoints (knowledge distillation). Errors are
    measured on every tenth image, which is held out.
    """
    from derender import learn

    scores = copied(learn.refine, "refining", images, model, out, output, settings, dry_run, seed=seed)
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
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Settings = None,
    seed: Seed = 0, dry_run: DryRun = False,
) -> None:  # fmt: skip
    """Write a copy of a model with U-Net encoders that learn its scenes pixel by pixel, without labels.

    The encoders of geometry and albedo are exchanged; light, camera, decoders and confidence stay. The copy
    is for derender evaluate segment, and decomposes images, too.
    """
    from derender import learn

    scores = copied(learn.unet, "distilling", images, model, out, output, settings, dry_run, seed=seed)
    errors = scores["errors"]
    notice(
        f"mean errors against {model.model}: place {errors['place']:.2f} pixels, depth {errors['depth']:.1%} "
        f"of its range, albedo {errors['albedo']:.3f}; reconstruction {errors['reconstruction']:.4f}, before "
        f"{errors['reconstruction before']:.4f}"
    )
