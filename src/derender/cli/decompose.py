"""`derender decompose`: each image as its factors: panels, single images and numbers."""

from functools import partial
from typing import Annotated

import typer

from derender.cli.gathered import gathered
from derender.cli.images import ImageFiles, opener_of
from derender.cli.options import Output, TrainedModel
from derender.report.opening import ImageOptions


def register(app: typer.Typer) -> None:
    app.command(
        "decompose", epilog="Example: derender decompose --model runs/faces me.jpg you.png --out apart/"
    )(decompose)


@gathered
def decompose(
    files: ImageFiles,
    model: TrainedModel,
    how: ImageOptions,
    output: Output,
    sheet: Annotated[
        bool, typer.Option("--sheet", help="Also draw all images below each other as sheet.png.")
    ] = False,
) -> None:
    """Write a folder per image: panel.png, one PNG per factor, scene.json and scene.npz."""
    from derender.report.decomposition import decomposed

    opener = opener_of(model, how, default_detail="model")
    files.edit(opener, partial(decomposed, opener.model), output, sheet=sheet)
