"""`derender evaluate geometry`: is the geometry the true one?"""

from derender.cli import options, scoring
from derender.cli.console import progress_bar


def geometry(
    images: options.DataOptions,
    trained: options.TrainedModel,
    published: scoring.Published,
    batch_size: options.BatchSize = 64,
    fit_steps: options.FitSteps = None,
    resamples: scoring.Resamples = 1_000,
    seed: options.Seed = 0,
    cache: scoring.Cache = None,
) -> None:
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
