"""`derender align`: the faces of photographs, cut out upright as models of faces take them."""

from typing import Annotated

import typer

from derender.cli.console import progress_bar
from derender.cli.gathered import command
from derender.cli.options import DataOptions, OutFolder, Output

MODEL = "Cut as this model of faces was trained, and reject faces that it reconstructs badly."
Model = Annotated[str | None, typer.Option("--model", "-m", help=MODEL, metavar="MODEL")]
Size = Annotated[int, typer.Option(min=8, max=4096, help="Side of the crops in pixels.")]
MARGIN = "More of the surroundings on every side, in shares of the side."
Margin = Annotated[float, typer.Option(min=0, max=2, help=MARGIN)]
Largest = Annotated[bool, typer.Option("--largest", help="Only the largest face of each photograph.")]


@command("align", "align photos/ --out aligned/")
def align(
    photos: DataOptions, out: OutFolder, output: Output, model: Model = None, size: Size = 256,
    margin: Margin = 0.0, largest: Largest = False,
) -> None:  # fmt: skip
    """Find every face of photographs, and write it upright and centred, as models of faces take it.

    boxes.csv names each box, rejected ones with the reason, and the transform from the crop's pixels to the
    photograph's. A stopped run continues when the command is given again.
    """
    import derender

    with progress_bar("searching", "photographs") as report:
        done = derender.align(
            photos.address, out, model=model, size=size, margin=margin, largest=largest, **photos.how,
            overwrite=output.force, progress=report,
        )  # fmt: skip
    output.result(f"{done.describe()} in {out}")
    output.write({"out": out, **done.counts, "resumed": done.resumed, "boxes": done.rows})
