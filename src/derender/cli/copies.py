"""`derender whiten`, `refine` and `unet`: copies of a model, changed by images."""

from derender import learn
from derender.cli.console import notice
from derender.cli.options import Copying, OutModel, Output, PartOfImages, TrainedModel, command


@command("whiten", "whiten photos/ --model rendered-faces-64 --out mine")
def whiten(images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, how: Copying) -> None:
    """Write a copy of a model whose features move as little as possible with other factors.

    They are estimated on these images, without labels, and so is how albedo and lighting share brightness.
    Weights and reconstructions stay as they are. Training ends with this by itself. With --set steps=20
    features also hold scenes optimised for each image by rendering.
    """
    scores = how.make(learn.whiten, "re-rendering", images, model, out, output)
    for name, ratios in scores["between_over_within"].items():
        clear = sum(ratio > 1 for ratio in ratios)
        differ = f"in {clear} images differ more than one does where other factors change"
        notice(f"{name}: {len(ratios)} directions kept; {differ}")


@command("refine", "refine photos/ --model runs/mine --part train --out refined")
def refine(images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, how: Copying) -> None:
    """Write a copy of a model that predicts at once the scenes that test-time optimisation finds slowly.

    Scenes are optimised for these images once, without labels. The encoders then learn to predict them from
    the images and from renderings under other lighting and viewpoints (knowledge distillation). Errors are
    measured on every tenth image, which is held out.
    """
    scores = how.make(learn.refine, "refining", images, model, out, output)
    errors = scores["errors"]
    now = f"reconstructed with an error of {errors['now']:.4f}"
    others = f"before {errors['before']:.4f}, fitted {errors['fitted']:.4f}"
    notice(f"{scores['held_out']} held-out images: {now}, {others}")
    for name, gap in scores["gaps"].items():
        notice(f"{name}: {gap['now']:.2f} mean deviations from fitted scenes, before {gap['before']:.2f}")


@command("unet", "unet photos/ --model faces-64 --out faces-unet")
def unet(images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, how: Copying) -> None:
    """Write a copy of a model with U-Net encoders that learn its scenes pixel by pixel, without labels.

    The encoders of geometry and albedo are exchanged; light, camera, decoders and confidence stay. The copy
    is for derender evaluate segment, and decomposes images, too.
    """
    scores = how.make(learn.unet, "distilling", images, model, out, output)
    errors = scores["errors"]
    shares = f"depth {errors['depth']:.1%} of its range, albedo {errors['albedo']:.3f}"
    again = f"reconstruction {errors['reconstruction']:.4f}, before {errors['reconstruction before']:.4f}"
    notice(f"mean errors against {model.model}: place {errors['place']:.2f} pixels, {shares}; {again}")
