"""`derender relight`: images under other lighting."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from derender.cli.gathered import gathered
from derender.cli.images import ImageFiles, opener_of
from derender.cli.options import Output, TrainedModel
from derender.report.opening import EDIT_SIZE, FilmOptions, ImageOptions


def register(app: typer.Typer) -> None:
    app.command(
        "relight",
        epilog="Example: derender relight --model runs/faces me.jpg --like sunset.jpg --out relit/",
    )(relight)


@gathered
def relight(
    files: ImageFiles,
    model: TrainedModel,
    how: ImageOptions,
    output: Output,
    film: FilmOptions,
    like: Annotated[
        Path | None, typer.Option("--like", help="Go to the lighting of this image.", metavar="IMAGE")
    ] = None,
    reach: Annotated[
        float, typer.Option("--reach", help="Reach of the light to either side, in degrees.")
    ] = 60.0,
    pitch: Annotated[float, typer.Option("--pitch", help="Height of the light, in degrees.")] = 10.0,
    strength: Annotated[
        float, typer.Option("--strength", min=0, max=10, help="Strength in multiples of the image's own.")
    ] = 1.0,
) -> None:
    """Write strips and films of images under other lighting: from right to left, or to that of --like.

    A light is relative to the object, not to the camera: it falls on the same side of every face. Going
    round, it is as strong as the image's own, a third of it ambient.
    """
    from derender.report.edits import relit

    opener = opener_of(model, how, EDIT_SIZE)
    others = [] if like is None else [opener.open(like)]
    edit = partial(
        relit, opener.model, reach_deg=reach, pitch_deg=pitch, strength=strength,
        like=others[0] if others else None, film=film,
    )  # fmt: skip
    files.edit(opener, edit, output, beside=others)
