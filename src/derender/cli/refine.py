"""`derender refine`: a copy of a model that reads at once what fitting finds."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing, result, write_json


def register(app: typer.Typer) -> None:
    app.command(
        "refine",
        epilog="Example: derender refine --model runs/mine --data photos/ --part train --out refined",
    )(refine)


def refine(
    model: options.Model,
    data: options.Data,
    out: options.OutModel,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="images (how many are seen), batch_size, learning_rate, fitted (pictures), fit_steps, "
            "worst, rendered, exchanged, picture_weight, reframed (share shown in other frames, as "
            "reframe.farther=1.9, for models of pictures framed otherwise), strange; what is perturbed, as "
            "perturb.light_deg; for features what derender whiten takes.",
            metavar="KEY=VALUE",
        ),
    ] = None,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a copy of a model that reads at once what fitting finds slowly.

    Scenes are fitted to these pictures once, without labels; then the encoders learn to read them, from the
    pictures and from renderings of the fitted scenes in other light and from other sides. Every tenth picture
    teaches nothing: the errors are measured on those.
    """
    import torch

    from derender.cli.models import fitting_of, keep_split, open_model, pictures_for
    from derender.data import split_indices
    from derender.training.config import with_changes
    from derender.training.held_out_errors import store_errors
    from derender.training.refining import RefineConfig, refine

    refuse_existing(out, force)
    config = with_changes(RefineConfig(), overrides or [])
    net = open_model(model, device)
    fitting_of(net, model)
    chosen = pictures_for(net, model, data, dataset=dataset, part=part, limit=limit, fewest=10)
    split = split_indices(chosen.files, (0.9, 0.1, 0.0), seed=seed)
    images = torch.from_numpy(chosen.images)
    own, held_out = images[split.train], images[split.validation]
    with progress_bar("refining") as report:
        refined = refine(net, own, held_out, config, seed=seed, progress=report)
    folder = refined.model.save(out, overwrite=force)
    store_errors(folder, held_out)
    if part == "train":  # other pictures taught, too, so nobody could say which did not
        keep_split(folder, model)
    errors = refined.errors
    notice(
        f"{len(held_out)} pictures that taught nothing: rendered again with an error of {errors['now']:.4f}, "
        f"before {errors['before']:.4f}, fitted {errors['fitted']:.4f}"
    )
    for name, gap in refined.gaps.items():
        notice(
            f"{name}: {gap['now']:.2f} of the spread away from what fitting finds, before {gap['before']:.2f}"
        )
    result(f"model {folder}", json_file)
    write_json(
        json_file,
        {"model": folder, "pictures": len(own), "held_out": len(held_out)}
        | {"errors": errors, "gaps": refined.gaps},
    )
