"""`derender whiten`: a model's features, fitted to the pictures they will be used on."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing, result, write_json


def register(app: typer.Typer) -> None:
    app.command(
        "whiten", epilog="Example: derender whiten --model rendered-faces-64 --data photos/ --out mine"
    )(whiten)


def whiten(
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
            help="pictures, views, spatial, mirrored, directions, shrinkage, evenness, vectors, "
            "vector_power, frames and how far they go, as reframe.farther; examples, coordinates, steps, "
            "prior, tolerance, weight of fitting; what is perturbed, as perturb.light_deg.",
            metavar="KEY=VALUE",
        ),
    ] = None,
    mean_only: Annotated[
        bool,
        typer.Option(
            "--mean-only",
            help="Keep the model's own directions; take only the mean of its features from these pictures.",
        ),
    ] = False,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a copy of a model whose features move as little as can be with other factors.

    It is fitted to these pictures, without labels. Weights and scenes stay as they are. Training ends with
    this by itself. With --set steps=60 features are also made of scenes fitted to each picture by rendering.
    """
    from dataclasses import replace

    import torch

    from derender.cli.models import keep_split, open_model, pictures_for
    from derender.training.config import FeatureSettings, with_changes
    from derender.training.features import make_features
    from derender.training.whitening import recentre

    refuse_existing(out, force)
    settings = with_changes(FeatureSettings(), overrides or [])
    if settings.whitening.pictures < 2:
        raise ValueError("whitening needs 2 pictures or more: set pictures=2000, say")
    if mean_only and overrides:
        raise ValueError(f"with --mean-only nothing is fitted: leave out --set {overrides[0]}")
    net = open_model(model, device)
    chosen = pictures_for(net, model, data, dataset=dataset, part=part, limit=limit, fewest=2)
    images = torch.from_numpy(chosen.images)
    if mean_only:
        with progress_bar("reading pictures") as report:
            net = net.with_features(replace(net.features, whitening=recentre(net, images, progress=report)))
    else:
        with progress_bar("rendering again") as report:
            net = make_features(net, images, settings, seed=seed, progress=report)
    assert net.whitening is not None
    folder = net.save(out, overwrite=force)
    keep_split(folder, model)
    ratios = {name: net.whitening.get_buffer(f"{name}_ratios").tolist() for name in net.whitening.names}
    for name, values in ratios.items():
        clear = sum(value > 1 for value in values)
        notice(
            f"{name}: {len(values)} directions kept; in {clear} pictures differ more than one does where "
            "other factors change"
        )
    result(f"model {folder}", json_file)
    write_json(json_file, {"model": folder, "pictures": len(chosen), "between_over_within": ratios})
