"""`derender embed`: one feature per factor for every image, in one parquet file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from derender.baselines import BASELINES
from derender.cli import options
from derender.cli.console import NAMED, notice, progress_bar, visible
from derender.cli.options import command, option
from derender.storage.places import counted

NAMES = ", ".join(BASELINES)
SIDE = "Side of the images in pixels, where no network fixes it (64); e4e enlarges them to its own."
FEATURES = "Features of a baseline, separated by commas."
KEEP = "Keep every one of identical images, as labelled sets need."
PANEL = {"rich_help_panel": "Baselines"}


@dataclass(frozen=True)
class BaselineOptions:
    """Another network or control in place of our model."""

    baseline: str | None = option(None, f"Instead of our model: {NAMES}.", metavar="NAME", **PANEL)
    features: str | None = option(None, FEATURES, metavar="A,B", **PANEL)
    image_size: int | None = option(None, SIDE, min=8, metavar="N", **PANEL)
    components: int = option(64, "Numbers in pca and noise.", min=1, metavar="N", **PANEL)
    seed: int = option(0, "Seed of pca, noise and untrained.", min=0, metavar="N", **PANEL)


@command("embed", "embed photos/ --model runs/faces --out features.parquet")
def embed(
    images: options.PartOfImages, baselines: BaselineOptions, output: options.Output,
    batch_size: options.BatchSize = 256, fit_steps: options.FitSteps = None, device: options.Device = "auto",
    out: Path = option(..., "The table to write.", "--out", "-o", metavar="FILE.parquet"),
    model: str | None = option(None, options.MODELS, "--model", "-m", metavar="MODEL"),
    keep_duplicates: bool = option(False, KEEP, "--keep-duplicates"),
    engine: str = option("local", "local, or ray: on a cluster of Ray.", metavar="NAME"),
    workers: int | None = option(None, "Number of Ray actors; default: 2.", min=1, metavar="N"),
) -> None:  # fmt: skip
    """Write a feature table: file, one list column per factor, and the labels of the data set.

    Images are read, embedded and written as they come, so memory does not grow with their number. A stopped
    run continues where it was when the command is given again.
    """
    output.check(out)
    import derender
    from derender.features.embedding import unlike_training

    name = baselines.baseline
    if name is None and model is None:
        raise ValueError("give --model RUN, or --baseline NAME (see derender embed --help)")
    if name is not None and fit_steps is not None:
        raise ValueError("--fit-steps belongs to our models: leave it out with --baseline")
    if engine == "local" and workers is not None:
        raise ValueError("--workers belongs to --engine ray: leave it out, every core is used")
    how: dict[str, Any] = {"batch_size": batch_size, "engine": engine, "workers": workers}
    with progress_bar("embedding") as report:
        how |= {"fresh": output.force, "device": device, "progress": report}
        reading: dict[str, Any] = {**images.how, "keep_duplicates": keep_duplicates}
        if name is None:
            done = derender.embed_to_file(images.address, model, out, **reading, fit_steps=fit_steps, **how)
        else:
            how["features"] = baselines.features and [part.strip() for part in baselines.features.split(",")]
            how |= {option: getattr(baselines, option) for option in ("image_size", "components", "seed")}
            done = derender.baselines.embed_baseline(name, images.address, out, model, **reading, **how)
    named = (f"skipped {visible(row.file, '')}: {row.reason}" for row in done.examples[:NAMED])
    notice(done.describe(), *named)
    sizes = ", ".join(f"{factor} {size}" for factor, size in done.factors.items())
    if name is None and (odd := unlike_training(images.address, model, **images.how)):
        notice(odd)
    output.result(f"{counted(done.rows, 'rows')} in {out}: {sizes}")
    names = ("rows", "factors", "labels", "origin", "skipped", "copies", "resumed")
    output.write({"out": out, **{name: getattr(done, name) for name in names}})
