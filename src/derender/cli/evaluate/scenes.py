"""`derender evaluate geometry` and `reconstruction`: is the geometry true, and the image rendered well?"""

from dataclasses import dataclass, replace
from typing import Any

from derender.cli import options, scoring
from derender.cli.console import notice
from derender.cli.options import DataOptions, command, option
from derender.cli.scoring import Published

STORE = "Store the errors with the model, to detect out-of-distribution images: use unseen images."


@dataclass(frozen=True)
class Decomposed(options.TrainedModel):
    """The model that decomposes, and how its scenes are scored."""

    fit_steps: options.FitSteps = None
    resamples: scoring.Resamples = 1_000
    seed: options.Seed = 0

    @property
    def how(self) -> dict[str, Any]:
        """Keywords of the protocols."""
        return {"fit_steps": self.fit_steps, "resamples": self.resamples, "seed": self.seed}

    def score(self, protocol: str, images: DataOptions, published: Published, **own: Any) -> None:
        """Score by a protocol of `derender.evaluation`, and publish."""
        how: dict[str, Any] = {**self.how, **images.how, **own, "doing": "decomposing"}
        published.publish(scoring.measured(protocol, self.open(), images.address, **how), half=images.half)


@command("geometry", "evaluate geometry made/::test_gt --model runs/faces", scoring.evaluate)
def geometry(
    images: DataOptions, model: Decomposed, published: Published,
    batch_size: options.BatchSize = 64, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Is the geometry the true one? SIDE and MAD on rendered images with exact depth, beside controls.

    Images: a rendered set (as from derender synth), or folders image/ and depth/ with PNGs side by side.
    """
    if images.dataset != "auto":
        raise ValueError("sets with depth are recognised by themselves: leave --dataset out")
    model.score("geometry", images, published, batch_size=batch_size, cache=cache)


@command("reconstruction", "evaluate reconstruction photos/ --model runs/faces --part test", scoring.evaluate)
def reconstruction(
    images: options.PartOfImages, model: Decomposed, published: Published,
    batch_size: options.BatchSize = 64, cache: scoring.Cache = None,
    store: bool = option(False, STORE, "--store"),
) -> None:  # fmt: skip
    """How well are images reconstructed? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean image, 64 principal components of the pixels, and an untrained model.
    """
    from derender.inputs import part_of
    from derender.storage.places import model_folder
    from derender.training.held_out_errors import errors_of, write_errors

    loaded = model.open()
    known = replace(images, part="all").read(loaded.image_size)
    chosen = part_of(known, images.part, model.model)
    learned = known if images.part == "all" else part_of(known, "train", model.model)
    scores = scoring.measured(
        "reconstruction", loaded, chosen, training_images=learned, **model.how, batch_size=batch_size,
        cache=cache, doing="rendering",
    )  # fmt: skip
    published.publish(scores, part=images.part, half=images.half)
    if store:
        file = write_errors(model_folder(model.model), errors_of(loaded, chosen.images, batch_size))
        notice(f"errors of {len(chosen):,} images stored in {file}")
