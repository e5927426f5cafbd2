"""`derender unet`: a copy of a model with U-Net encoders, for segmentation."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing, result, write_json


def register(app: typer.Typer) -> None:
    app.command("unet", epilog="Example: derender unet --model faces-64 --data photos/ --out faces-unet")(
        unet
    )


def unet(
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
            help="images (how many are seen), batch_size, learning_rate, weight_decay, code_weight, "
            "unet_width, precision (32-true or bf16-mixed).",
            metavar="KEY=VALUE",
        ),
    ] = None,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a copy of a model whose geometry and albedo encoders are U-Nets, for segmentation.

    They learn, without labels, what the model says of these pictures, pixel by pixel: where on the thing each
    lies, how deep it is, its albedo; so does a decoder over both. derender evaluate segment begins with them.
    The copy takes pictures apart less well than the model does, and its features are codes.
    """
    import torch

    from derender.cli.models import keep_split, open_model, pictures_for
    from derender.training.config import with_changes
    from derender.training.unets import TeachingSettings, teach_unets

    refuse_existing(out, force)
    settings = with_changes(TeachingSettings(), overrides or [])
    net = open_model(model, device)
    chosen = pictures_for(net, model, data, dataset=dataset, part=part, limit=limit, fewest=2)
    with progress_bar("teaching") as report:
        taught = teach_unets(net, torch.from_numpy(chosen.images), settings, seed=seed, progress=report)
    folder = taught.model.save(out, overwrite=force)
    if part == "train":  # other pictures taught, too, so nobody could say which did not
        keep_split(folder, model)
    errors = taught.errors
    notice(
        f"mean errors against what {model} says: place {errors['place']:.2f} pixels, depth "
        f"{errors['depth']:.1%} of its range, albedo {errors['albedo']:.3f}; reconstruction "
        f"{errors['reconstruction']:.4f}, before {errors['reconstruction before']:.4f}"
    )
    result(f"model {folder}", json_file)
    write_json(json_file, {"model": folder, "pictures": len(chosen), "errors": errors})
