"""`derender embed`: one feature per factor for every image, in one parquet file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from derender.baselines.registry import BASELINES, row_of
from derender.cli import options
from derender.cli.console import NAMED, notice, progress_bar, visible
from derender.cli.gathered import gathered

Out = Annotated[Path, typer.Option("--out", "-o", help="The table to write.", metavar="FILE.parquet")]
Model = Annotated[str | None, typer.Option("--model", "-m", help=options.MODELS, metavar="MODEL")]
Engine = Annotated[
    str, typer.Option("--engine", help="local, or ray: on the machines of a Ray cluster.", metavar="NAME")
]
Workers = Annotated[
    int | None, typer.Option("--workers", min=1, metavar="N", help="Number of Ray actors; default: 2.")
]


def _option(help: str, *names: str, metavar: str = "N", **more: Any) -> Any:
    return typer.Option(*names, help=help, metavar=metavar, rich_help_panel="Baselines", **more)


@dataclass(frozen=True)
class BaselineOptions:
    """Another network or control in place of our model."""

    baseline: Annotated[
        str | None, _option(f"Instead of our model: {', '.join(BASELINES)}.", "--baseline", metavar="NAME")
    ] = None
    checkpoint: Annotated[
        str | None,
        _option(
            "Published e4e file such as e4e_ffhq_encode.pt, for --model.", "--checkpoint", metavar="FILE"
        ),
    ] = None
    features: Annotated[
        str | None, _option("Features of a baseline, separated by commas.", "--features", metavar="A,B")
    ] = None
    image_size: Annotated[
        int, _option("Side in pixels, where no network fixes it.", "--image-size", min=8)
    ] = 64
    components: Annotated[int, _option("Numbers in pca and noise.", "--components", min=1)] = 64
    seed: Annotated[int, _option("Seed of pca, noise and untrained.", "--seed", min=0)] = 0


def register(app: typer.Typer) -> None:
    example = "derender embed photos/ --model runs/faces --out features.parquet"
    app.command("embed", epilog=f"Example: {example}")(embed)


@gathered
def embed(
    images: options.PartOfImages, out: Out, baselines: BaselineOptions, output: options.Output,
    model: Model = None, batch_size: options.BatchSize = 256, fit_steps: options.FitSteps = None,
    device: options.Device = "auto", engine: Engine = "local", workers: Workers = None,
) -> None:  # fmt: skip
    """Write a feature table: file, one list column per factor, and the labels of the data set.

    Images are read, embedded and written as they come, so memory does not grow with their number. A run that
    was stopped goes on where it was when the command is given again.
    """
    output.refuse_existing(out)
    import derender

    name, source = baselines.baseline, model or baselines.checkpoint
    if baselines.checkpoint is not None and (name != "e4e" or model is not None):
        raise ValueError("--checkpoint is a published e4e file: give it with --baseline e4e and no --model")
    if name is None and model is None:
        raise ValueError("give --model RUN, or --baseline NAME (see derender embed --help)")
    if engine == "local" and workers is not None:
        raise ValueError("--workers belongs to --engine ray: leave it out, every core is used")
    if name is not None and not row_of(name).opener:
        with progress_bar("describing") as report:
            table = derender.baselines.control_features(
                name, images.address, **images.how, model=model, image_size=baselines.image_size,
                components=baselines.components, seed=baselines.seed, progress=report,
            )  # fmt: skip
        table.write(out)
        factors = {factor: made.shape[1] for factor, made in table.factors.items()}
        values = {
            "rows": len(table),
            "factors": factors,
            "labels": list(table.labels),
            "origin": table.origin,
        }
    else:
        net, origin = model, {"source": source}
        if name is not None:
            chosen = baselines.features and [part.strip() for part in baselines.features.split(",")]
            sizes = {"image_size": baselines.image_size, "seed": baselines.seed}
            net = derender.baselines.open_baseline(name, source, device=device, features=chosen, **sizes)
            origin["baseline"] = name
        with progress_bar("embedding") as report:
            done = derender.embed_to_file(
                images.address, net, out, **images.how, batch_size=batch_size, fit_steps=fit_steps,
                device=device, engine=engine, workers=workers, fresh=output.force, origin=origin,
                progress=report,
            )  # fmt: skip
        named = (f"skipped {visible(row.file, '')}: {row.reason}" for row in done.examples[:NAMED])
        notice("\n".join([done.describe(), *named]))
        values = done.__dict__
    shown = ", ".join(f"{factor} {size}" for factor, size in values["factors"].items())
    output.result(f"{values['rows']:,} rows in {out}: {shown}")
    names = ("rows", "factors", "labels", "origin", "skipped", "copies", "resumed")
    output.write({"out": out, **{name: values[name] for name in names if name in values}})
