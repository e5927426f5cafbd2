"""`derender rotate`: images from other viewpoints."""

from functools import partial
from typing import Annotated

import typer

from derender.cli.gathered import gathered
from derender.cli.images import ImageFiles, opener_of
from derender.cli.options import Output, TrainedModel
from derender.report.opening import EDIT_SIZE, FilmOptions, ImageOptions


def register(app: typer.Typer) -> None:
    app.command(
        "rotate",
        epilog="Example: derender rotate --model runs/faces me.jpg --reach 45 --out rotated/",
    )(rotate)


@gathered
def rotate(
    files: ImageFiles,
    model: TrainedModel,
    how: ImageOptions,
    output: Output,
    film: FilmOptions,
    reach: Annotated[
        float, typer.Option("--reach", help="Rotation of the object to either side, in degrees.")
    ] = 40.0,
    pitch: Annotated[float, typer.Option("--pitch", help="Nod in degrees: the top comes forward.")] = 0.0,
) -> None:
    """Write strips and films of images rotated from one side to the other, in their own lighting."""
    from derender.report.edits import rotated

    opener = opener_of(model, how, EDIT_SIZE)
    files.edit(opener, partial(rotated, opener.model, reach_deg=reach, pitch_deg=pitch, film=film), output)
