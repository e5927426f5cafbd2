"""`derender embed`: one feature per factor for every image, in one parquet file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from derender.baselines import BASELINES
from derender.cli import options
from derender.cli.console import NAMED, notice, progress_bar, refuse_existing_file, visible
from derender.cli.gathered import command

NAMES = ", ".join(BASELINES)
SIDE = "Side of the images in pixels, where no network fixes it (64); e4e enlarges them to its own."
Out = Annotated[Path, typer.Option("--out", "-o", help="The table to write.", metavar="FILE.parquet")]
Model = Annotated[str | None, typer.Option("--model", "-m", help=options.MODELS, metavar="MODEL")]
KEEP = "Keep every one of identical images, as labelled sets need."
Keep = Annotated[bool, typer.Option("--keep-duplicates", help=KEEP)]
Engine = Annotated[str, typer.Option(help="local, or ray: on a cluster of Ray.", metavar="NAME")]
Workers = Annotated[int | None, typer.Option(min=1, metavar="N", help="Number of Ray actors; default: 2.")]


def _option(help: str, metavar: str = "N", **more: Any) -> Any:
    return typer.Option(help=help, metavar=metavar, rich_help_panel="Baselines", **more)


@dataclass(frozen=True)
class BaselineOptions:
    """Another network or control in place of our model."""

    baseline: Annotated[str | None, _option(f"Instead of our model: {NAMES}.", "NAME")] = None
    features: Annotated[str | None, _option("Features of a baseline, separated by commas.", "A,B")] = None
    image_size: Annotated[int | None, _option(SIDE, min=8)] = None
    components: Annotated[int, _option("Numbers in pca and noise.", min=1)] = 64
    seed: Annotated[int, _option("Seed of pca, noise and untrained.", min=0)] = 0


@command("embed", "embed photos/ --model runs/faces --out features.parquet")
def embed(
    images: options.PartOfImages, out: Out, baselines: BaselineOptions, output: options.Output,
    model: Model = None, batch_size: options.BatchSize = 256, fit_steps: options.FitSteps = None,
    keep_duplicates: Keep = False, device: options.Device = "auto", engine: Engine = "local",
    workers: Workers = None,
) -> None:  # fmt: skip
    """Write a feature table: file, one list column per factor, and the labels of the data set.

    Images are read, embedded and written as they come, so memory does not grow with their number. A stopped
    run continues where it was when the command is given again.
    """
    refuse_existing_file(out, output.force)
    import derender

    name = baselines.baseline
    if name is None and model is None:
        raise ValueError("give --model RUN, or --baseline NAME (see derender embed --help)")
    if engine == "local" and workers is not None:
        raise ValueError("--workers belongs to --engine ray: leave it out, every core is used")
    how = {"batch_size": batch_size, "engine": engine, "workers": workers, "fresh": output.force}
    with progress_bar("embedding") as report:
        how |= {"device": device, "progress": report}
        if name is None:
            how |= {**images.how, "fit_steps": fit_steps, "keep_duplicates": keep_duplicates}
            done = derender.embed_to_file(images.address, model, out, **how)
        else:
            how["features"] = baselines.features and [part.strip() for part in baselines.features.split(",")]
            how |= {option: getattr(baselines, option) for option in ("image_size", "components", "seed")}
            call = derender.baselines.embed_baseline
            done = call(name, images.address, out, model, reading=images.how, **how)
    named = (f"skipped {visible(row.file, '')}: {row.reason}" for row in done.examples[:NAMED])
    notice("\n".join([done.describe(), *named]))
    sizes = ", ".join(f"{factor} {size}" for factor, size in done.factors.items())
    if name is None and (odd := derender.features.unlike_training(images.address, model, **images.how)):
        notice(odd)
    output.result(f"{done.rows:,} rows in {out}: {sizes}")
    names = ("rows", "factors", "labels", "origin", "skipped", "copies", "resumed")
    output.write({"out": out, **{name: getattr(done, name) for name in names}})
