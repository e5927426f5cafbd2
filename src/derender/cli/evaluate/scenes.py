"""`derender evaluate geometry` and `reconstruction`: is the geometry true, and the image rendered well?"""

from dataclasses import replace
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import notice, progress_bar

STORE = "Store the errors with the model, to detect out-of-distribution images: use unseen images."
Store = Annotated[bool, typer.Option("--store", help=STORE)]


def geometry(
    images: options.DataOptions, trained: options.TrainedModel, published: scoring.Published,
    batch_size: options.BatchSize = 64, fit_steps: options.FitSteps = None,
    resamples: scoring.Resamples = 1_000, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Is the geometry the true one? SIDE and MAD on rendered images with exact depth, beside controls.

    Images: a rendered set (as from derender synth), or folders image/ and depth/ with PNGs side by side.
    """
    published.check()
    from derender import evaluation
    from derender.data import read_ground_truth
    from derender.evaluation.memory import memory_in

    model, memory = trained.open(), memory_in(cache)
    truth = read_ground_truth(images.address, limit=images.limit, image_size=model.image_size)
    with progress_bar("decomposing") as report:
        scores = evaluation.geometry(
            model, truth, fit_steps=fit_steps, resample_count=resamples, seed=seed, batch_size=batch_size,
            memory=memory, progress=report,
        )  # fmt: skip
    published.publish(scores, memory)


def reconstruction(
    images: options.PartOfImages, trained: options.TrainedModel, published: scoring.Published,
    batch_size: options.BatchSize = 64, fit_steps: options.FitSteps = None, store: Store = False,
    resamples: scoring.Resamples = 1_000, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """How well are images reconstructed? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean image, 64 principal components of the pixels, and an untrained model.
    """
    published.check()
    from derender import evaluation
    from derender.evaluation.memory import memory_in
    from derender.inputs import part_of
    from derender.storage.places import model_folder
    from derender.training.held_out_errors import errors_of, write_errors

    model, memory = trained.open(), memory_in(cache)
    known = replace(images, part="all").read(model.image_size)
    chosen = part_of(known, images.part, trained.model)
    learned = known if images.part == "all" else part_of(known, "train", trained.model)
    with progress_bar("rendering") as report:
        scores = evaluation.reconstruction(
            model, chosen, training_images=learned, fit_steps=fit_steps, resample_count=resamples, seed=seed,
            batch_size=batch_size, memory=memory, progress=report,
        )  # fmt: skip
    published.publish(scores, memory, part=images.part)
    if store:
        file = write_errors(model_folder(trained.model), errors_of(model, chosen.images, batch_size))
        notice(f"errors of {len(chosen):,} images stored in {file}")
