"""`derender evaluate geometry` and `reconstruction`: is the geometry true, and the image rendered well?"""

from dataclasses import replace

from derender.cli import options, scoring
from derender.cli.console import notice
from derender.cli.options import option

STORE = "Store the errors with the model, to detect out-of-distribution images: use unseen images."


def geometry(
    images: options.DataOptions, trained: options.TrainedModel, published: scoring.Published,
    batch_size: options.BatchSize = 64, fit_steps: options.FitSteps = None,
    resamples: scoring.Resamples = 1_000, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Is the geometry the true one? SIDE and MAD on rendered images with exact depth, beside controls.

    Images: a rendered set (as from derender synth), or folders image/ and depth/ with PNGs side by side.
    """
    if images.dataset != "auto":
        raise ValueError("sets with depth are recognised by themselves: leave --dataset out")
    scores = scoring.measured(
        "geometry", trained.open(), images.address, limit=images.limit, fit_steps=fit_steps, seed=seed,
        resamples=resamples, batch_size=batch_size, cache=cache, doing="decomposing",
    )  # fmt: skip
    published.publish(scores)


def reconstruction(
    images: options.PartOfImages, trained: options.TrainedModel, published: scoring.Published,
    batch_size: options.BatchSize = 64, fit_steps: options.FitSteps = None,
    store: bool = option(False, STORE, "--store"),
    resamples: scoring.Resamples = 1_000, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """How well are images reconstructed? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean image, 64 principal components of the pixels, and an untrained model.
    """
    from derender.inputs import part_of
    from derender.storage.places import model_folder
    from derender.training.held_out_errors import errors_of, write_errors

    model = trained.open()
    known = replace(images, part="all").read(model.image_size)
    chosen = part_of(known, images.part, trained.model)
    learned = known if images.part == "all" else part_of(known, "train", trained.model)
    scores = scoring.measured(
        "reconstruction", model, chosen, training_images=learned, fit_steps=fit_steps,
        resamples=resamples, seed=seed, batch_size=batch_size, cache=cache, doing="rendering",
    )  # fmt: skip
    published.publish(scores, part=images.part)
    if store:
        file = write_errors(model_folder(trained.model), errors_of(model, chosen.images, batch_size))
        notice(f"errors of {len(chosen):,} images stored in {file}")
