"""`derender evaluate reconstruction`: how well are images reconstructed?"""

from dataclasses import replace
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import notice, progress_bar


def reconstruction(
    images: options.PartOfImages,
    trained: options.TrainedModel,
    published: scoring.Published,
    batch_size: options.BatchSize = 64,
    fit_steps: options.FitSteps = None,
    store: Annotated[
        bool,
        typer.Option(
            "--store",
            help="Store the errors with the model, to detect out-of-distribution images: use unseen images.",
        ),
    ] = False,
    resamples: scoring.Resamples = 1_000,
    seed: options.Seed = 0,
    cache: scoring.Cache = None,
) -> None:
    """How well are images reconstructed? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean image, 64 principal components of the pixels, and an untrained model.
    """
    published.check()
    from derender import evaluation
    from derender.evaluation.memory import memory_in
    from derender.inputs import part_of
    from derender.storage.folder import model_folder
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
