"""`derender decompose`: pictures taken apart, as panels, single images and numbers."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import progress_bar
from derender.cli.given import (
    Frame,
    OwnSize,
    PictureFiles,
    PictureReader,
    Texture,
    batch_that_fits,
    finish,
    given_pictures,
    percentiles,
    refining,
)


def register(app: typer.Typer) -> None:
    app.command(
        "decompose", epilog="Example: derender decompose --model runs/faces me.jpg you.png --out apart/"
    )(decompose)


def decompose(
    images: PictureFiles,
    model: options.Model,
    out: options.OutFolder,
    size: OwnSize = None,
    texture: Texture = "model",
    fit_steps: options.FitSteps = None,
    frame: Frame = "whole",
    sheet: Annotated[
        bool, typer.Option("--sheet", help="Also draw all pictures below each other as sheet.png.")
    ] = False,
    batch_size: options.BatchSize = 64,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a folder per picture: panel.png, one PNG per factor, scene.json and scene.npz."""
    from derender.cli.models import open_model
    from derender.report.figures import Decomposition
    from derender.report.files import write_decompositions
    from derender.report.sheets import Sheets, write_sheets

    net = open_model(model, device)
    read = PictureReader(net, frame)
    refine = refining(read, size, texture, fit_steps, model)
    given = given_pictures(images, read, out, force, sheet=sheet)
    sheets, names = Sheets(), iter(given.pictures)

    def keep(drawn: Decomposition) -> None:
        for index in range(len(drawn)):
            row = {name: column[index] for name, column in drawn.columns.items()}
            sheets.add(next(names).name, row)

    with progress_bar("decomposing") as report:
        written = write_decompositions(
            net,
            dict(zip(given.folders, given.pictures.items(), strict=True)),
            batch_size=batch_that_fits(batch_size, size),
            refine=refine,
            progress=report,
            keep=keep if sheet else None,
        )
    odd = percentiles(model, net, given.pictures)
    finish(given, read, out, written, json_file, odd, sheets=write_sheets(sheets, out))
