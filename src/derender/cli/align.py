"""`derender align`: the faces of photographs, cut out upright as models of faces take them."""

import derender
from derender.cli.console import progress_bar
from derender.cli.options import DataOptions, OutFolder, Output, command, option

MODEL = "Cut as this model of faces was trained, and reject faces that it reconstructs badly."


@command("align", "align photos/ --out aligned/")
def align(
    photos: DataOptions,
    out: OutFolder,
    output: Output,
    model: str | None = option(None, MODEL, "--model", "-m", metavar="MODEL"),
    size: int = option(256, "Side of the crops in pixels.", min=8, max=4096),
    margin: float = option(0.0, "More surroundings on every side, in shares of the side.", min=0, max=2),
    largest: bool = option(False, "Only the largest face of each photograph.", "--largest"),
    keep: bool = option(False, "Of photographs without a face, keep the middle square.", "--keep"),
) -> None:
    """Find every face of photographs, and write it upright and centred, as models of faces take it.

    boxes.csv names each box, rejected ones with the reason, and the transform from the crop's pixels to the
    photograph's. A stopped run continues when the command is given again.
    """
    with progress_bar("searching", "photographs") as report:
        done = derender.align(
            photos.address, out, model=model, size=size, margin=margin, largest=largest, keep=keep,
            **photos.how, overwrite=output.force, progress=report,
        )  # fmt: skip
    output.result(f"{done.describe()} in {out}")
    output.write({"out": out, **done.counts, "resumed": done.resumed, "boxes": done.rows})
