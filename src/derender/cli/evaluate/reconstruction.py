"""`derender evaluate reconstruction`: how well are pictures rendered again?"""

from typing import Annotated

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import notice, progress_bar, report_images
from derender.cli.gathered import gathered

FITTED = 2_000  # pictures that give the principal components
RECONSTRUCTION_SHOWN = {"L1": ("l1", 1.0), "PSNR": ("psnr_db", 1.0), "SSIM": ("ssim", 1.0)}


def register(group: typer.Typer) -> None:
    group.command(
        "reconstruction",
        epilog="Example: derender evaluate reconstruction --model runs/faces --data photos/ --part test",
    )(reconstruction)


@gathered
def reconstruction(
    model: options.Model,
    data: options.Data,
    published: scoring.Published,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    batch_size: options.BatchSize = 64,
    fit_steps: options.FitSteps = None,
    store: Annotated[
        bool,
        typer.Option(
            "--store",
            help="Keep the errors with the model, to tell odd pictures: give pictures it did not see.",
        ),
    ] = False,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
) -> None:
    """How well are pictures rendered again? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean picture, 64 principal components of the pixels, and an untrained model.
    """
    published.check()
    import numpy as np

    from derender.baselines.controls import untrained_twin
    from derender.cli.models import open_model, part_of, with_fitted_scenes
    from derender.data import read_pictures
    from derender.evaluation import ReconstructionResult, evaluate_reconstruction, mean_picture
    from derender.evaluation.memory_values import recall_value
    from derender.evaluation.reconstruction import component_count, reconstruction_rows
    from derender.report.score_table import reconstruction_table
    from derender.report.tables_pictures import picture_verdicts, with_intervals
    from derender.storage.folder import model_folder
    from derender.training.held_out_errors import errors_of, write_errors

    net = open_model(model, device)
    with progress_bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    report_images(pictures)
    chosen = part_of(pictures, part, model)
    fitted = (pictures if part == "all" else part_of(pictures, "train", model)).images
    memory = feature_rows.memory_in(cache)
    components = fitted[np.linspace(0, len(fitted) - 1, min(len(fitted), FITTED)).astype(int)]
    inputs = {
        **feature_rows.model_facts(net), "images": chosen.images, "fitted": fitted, "seed": seed,
        "fit_steps": fit_steps or 0,
    }  # fmt: skip
    scored = with_fitted_scenes(net, model, fit_steps)
    with progress_bar("rendering") as report:
        found = recall_value(
            memory, "reconstruction", inputs, ReconstructionResult,
            lambda: evaluate_reconstruction(
                scored, chosen.images, mean=mean_picture(fitted), components_of=components,
                untrained=untrained_twin(net, seed), batch_size=batch_size, progress=report,
            ),
        )  # fmt: skip
    name = f"PCA ({component_count(len(components))})"
    scores = reconstruction_table(found, len(chosen), name)
    rows = reconstruction_rows(found, len(components), resamples)
    values = {
        "pictures": len(chosen), "part": part, "reconstruction": found,
        "intervals": {row.name: row.numbers() for row in rows},
    }  # fmt: skip
    notes = picture_verdicts(rows[0], RECONSTRUCTION_SHOWN, scores.columns)
    published.show(
        [with_intervals(scores, rows, RECONSTRUCTION_SHOWN)], values, [*notes, scoring.remembered(memory)]
    )
    if store:
        kept = write_errors(model_folder(model), errors_of(net, chosen.images, batch_size))
        notice(f"errors of {len(chosen):,} pictures kept in {kept}")
