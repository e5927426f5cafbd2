"""`derender evaluate pose`, `light`, `relight` and `brightness`: predicted scenes against known ones."""

from typing import Annotated

import typer

from derender.cli import scoring
from derender.cli.evaluate.scenes import Decomposed
from derender.cli.options import DataOptions, command, option
from derender.cli.scoring import Published

TABLE = ".npz, .csv or .parquet with name and the angles in degrees; default: labels."
Angles = Annotated[str | None, typer.Option("--table", metavar="FILE", help=TABLE)]
BY = "Without true albedo: label of the groups to compare, as race."


@command("pose", "evaluate pose lfw.zip --model faces-64 --table angles.csv", scoring.evaluate)
def pose(images: DataOptions, model: Decomposed, published: Published, table: Angles = None) -> None:
    """Yaw, pitch and roll against known angles: correlation, slope and error, beside controls."""
    model.score("pose", images, published, table=table)


@command("light", "evaluate light CroppedYale.zip --model faces-64", scoring.evaluate)
def light(images: DataOptions, model: Decomposed, published: Published, table: Angles = None) -> None:
    """Direction of the light against the known one: correlation, slope and error, beside controls."""
    model.score("light", images, published, table=table)


@command("relight", "evaluate relight CroppedYale.zip --model faces-64", scoring.evaluate)
def relight(
    images: DataOptions, model: Decomposed, published: Published,
    size: int = scoring.number(128, "Side in pixels of the images that are relit."),
) -> None:  # fmt: skip
    """Relit images against photographs in that light: PSNR and SSIM inside the mask, beside controls.

    The light is predicted for another person's image. Images: the cropped Extended Yale B, or others with
    identity and light among their labels.
    """
    model.score("relight", images, published, size=size)


@command("brightness", "evaluate brightness made/::test_gt --model runs/faces", scoring.evaluate)
def brightness(
    images: DataOptions, model: Decomposed, published: Published,
    by: str | None = option(None, BY, metavar="LABEL"),
) -> None:  # fmt: skip
    """Is albedo as bright as the surface? Slope and r on rendered images; by group on photographs."""
    model.score("brightness", images, published, by=by)
