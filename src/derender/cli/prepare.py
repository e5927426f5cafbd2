"""`derender align` and `doctor`: faces cut out of photographs, and whether images suit the method."""

from pathlib import Path

import typer

import derender
from derender.cli.console import notice, progress_bar, report_images
from derender.cli.options import DataOptions, OutFolder, Output, Seed, command, option

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
    keep: bool = option(False, "Keep the middle square of photographs without a face.", "--keep"),
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


@command("doctor", "doctor photos/ --out doctor.html")
def doctor(
    image_set: DataOptions,
    output: Output,
    out: Path | None = option(None, "Also write a page with examples.", "--out", "-o", metavar="FILE.html"),
    seed: Seed = 0,
    check: bool = option(False, "Exit with 1 where the images do not suit the method.", "--check"),
) -> None:
    """Say whether images suit the method: copies, crop, symmetry, view and light. Trains nothing."""
    output.check(out, output.json_file)
    from derender.data.doctor import doctor as examine

    with progress_bar("examining") as report:
        result = examine(image_set.address, **image_set.how, seed=seed, progress=report)
    report_images(result.images, "unreadable:", "unreadable files (--json names all)")
    output.result(result.describe())
    values = result.as_json()
    if out is not None:
        from derender.report.run import doctor_page

        values["report"] = doctor_page(result).write(out)
        output.result(f"report {out}")
    else:
        notice("add --out doctor.html for a page with example images")
    output.write(values)
    if check and result.verdict.word == "does not suit":
        raise typer.Exit(1)
