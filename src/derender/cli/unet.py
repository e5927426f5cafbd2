"""`derender unet`: a copy of a model with U-Net encoders, for segmentation."""

from typing import Annotated

from derender.cli.console import notice
from derender.cli.copies import changes, copied
from derender.cli.gathered import command
from derender.cli.options import OutModel, Output, PartOfImages, Seed, TrainedModel

SETTINGS = (
    "images (how many are seen), batch_size, learning_rate, weight_decay, code_weight, unet_width, precision "
    "(32-true or bf16-mixed)."
)
Changes = Annotated[list[str] | None, changes(SETTINGS)]


@command("unet", "unet photos/ --model faces-64 --out faces-unet")
def unet(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Changes = None,
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
