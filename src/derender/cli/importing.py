"""`derender import`: a checkpoint of unsup3d as a model of ours."""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, refuse_existing, result, write_json

PRESETS = ("faces", "cats", "cars")


def register(app: typer.Typer) -> None:
    app.command("import", epilog="Example: derender import unsup3d.pth --preset faces --out imported/")(
        import_checkpoint
    )


def import_checkpoint(
    checkpoint: Annotated[
        Path, typer.Argument(help="The .pth file that unsup3d wrote.", metavar="CHECKPOINT")
    ],
    out: options.OutModel,
    preset: Annotated[
        str, typer.Option("--preset", help=f"What it was trained on: {', '.join(PRESETS)}.")
    ] = "faces",
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Ranges it was trained with where they differ, as translation_z=0.1, fov_deg=10.",
            metavar="KEY=VALUE",
        ),
    ] = None,
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a model of ours with the weights of an unsup3d checkpoint. Nothing in the file is run."""
    refuse_existing(out, force)
    from derender.model import Derenderer
    from derender.networks.unsup3d import NETS
    from derender.presets import MODEL_PRESETS, named_preset
    from derender.training.config import with_changes

    ranges = named_preset(preset, {name: MODEL_PRESETS[name] for name in PRESETS}).ranges
    model = Derenderer.from_unsup3d(checkpoint, with_changes(ranges, overrides or []))
    folder = model.save_pretrained(
        out,
        data=f"what {checkpoint.name} was trained on: a checkpoint of unsup3d, imported, not trained further",
        licence="that of the checkpoint",
        scores="None were taken since it was imported.",
        overwrite=force,
    )
    counts = {name: sum(value.numel() for value in model.nets[name].parameters()) for name in NETS.values()}
    notice(
        f"{model.image_size} x {model.image_size} pictures, {sum(counts.values()):,} numbers; see how well "
        f"it renders yours: derender evaluate reconstruction --model {folder} --data YOURS"
    )
    result(f"model {folder}", json_file)
    write_json(json_file, {"model": folder, "numbers": counts, "image_size": model.image_size})
