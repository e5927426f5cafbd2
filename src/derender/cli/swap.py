"""`derender swap`: images with one factor of another."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from derender.cli.gathered import gathered
from derender.cli.images import ImageFiles, opener_of
from derender.cli.options import Output, TrainedModel
from derender.report.opening import EDIT_SIZE, ImageOptions


def register(app: typer.Typer) -> None:
    app.command(
        "swap",
        epilog="Example: derender swap --model runs/faces me.jpg --from you.jpg --factor albedo --out mixed/",
    )(swap)


@gathered
def swap(
    files: ImageFiles,
    model: TrainedModel,
    how: ImageOptions,
    output: Output,
    source: Annotated[Path, typer.Option("--from", help="Image to take from.", metavar="IMAGE")],
    factor: Annotated[
        list[str] | None,
        typer.Option(
            "--factor", help="Factor to take; may be repeated. By default each in turn.", metavar="NAME"
        ),
    ] = None,
) -> None:
    """Write images with one factor of another: its geometry, albedo, light or camera, each by itself."""
    from derender.report.edits import swappable, swapped_factors

    opener = opener_of(model, how, EDIT_SIZE)
    factors = list(swappable(opener.model, factor or ()))
    donor = opener.open(source)
    edit = partial(swapped_factors, opener.model, donor=donor, factors=factors)
    files.edit(opener, edit, output, beside=[donor])
