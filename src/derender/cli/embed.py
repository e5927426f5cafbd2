"""`derender embed`: one feature per factor for every picture, in one parquet file."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import options
from derender.cli.baselines import (
    BaselineCheckpoint,
    BaselineComponents,
    BaselineFeatures,
    BaselineImageSize,
    BaselineName,
    BaselineSeed,
)
from derender.cli.console import (
    NAMED,
    notice,
    progress_bar,
    refuse_existing_file,
    report_images,
    result,
    visible,
    write_json,
)

if TYPE_CHECKING:
    from derender.data import PictureSet, Stream
    from derender.features import Embedded

ENGINES = ("local", "ray")


def register(app: typer.Typer) -> None:
    app.command(
        "embed", epilog="Example: derender embed --model runs/faces --data photos/ --out features.parquet"
    )(embed)


def embed(
    data: options.Data,
    out: Annotated[Path, typer.Option("--out", "-o", help="The table to write.", metavar="FILE.parquet")],
    model: Annotated[
        str | None,
        typer.Option(
            "--model", "-m", help="Run folder, saved model or Hugging Face Hub id.", metavar="MODEL"
        ),
    ] = None,
    baseline: BaselineName = None,
    checkpoint: BaselineCheckpoint = None,
    features: BaselineFeatures = None,
    image_size: BaselineImageSize = 64,
    components: BaselineComponents = 64,
    seed: BaselineSeed = 0,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    batch_size: options.BatchSize = 256,
    fit_steps: options.FitSteps = None,
    device: options.Device = "auto",
    engine: Annotated[
        str, typer.Option("--engine", help="local, or ray: on the machines of a Ray cluster.", metavar="NAME")
    ] = "local",
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, metavar="N", help="Of --engine ray; default: 2.")
    ] = None,
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a feature table: file, one list column per factor, and the labels of the data set.

    Pictures are read, embedded and written as they come, so memory does not grow with their number. A run
    that was stopped goes on where it was when the command is given again.
    """
    refuse_existing_file(out, force)
    _check_engine(engine, workers, part)
    from derender.cli.models import open_model
    from derender.data import open_images
    from derender.features import embed_to_file
    from derender.features.ray_engine import ray_engine

    if baseline is not None:
        from derender.baselines import open_baseline
        from derender.baselines.registry import row_of
        from derender.cli.baselines import write_control
        from derender.cli.models import chosen_device

        if not row_of(baseline).opener:
            write_control(
                baseline, data, out, dataset=dataset, part=part, limit=limit, model=model,
                image_size=image_size, components=components, seed=seed, json_file=json_file,
            )  # fmt: skip
            return
        if checkpoint is not None and (baseline != "e4e" or model is not None):
            raise ValueError(
                "--checkpoint is a published e4e file: give it with --baseline e4e and no --model"
            )
        net = open_baseline(
            baseline, model or checkpoint, device=chosen_device(device),
            features=None if features is None else [part.strip() for part in features.split(",")],
            image_size=image_size, seed=seed,
        )  # fmt: skip
        origin = {"source": model or checkpoint, "baseline": baseline}
    elif checkpoint is not None:
        raise ValueError("--checkpoint is a published e4e file: give it with --baseline e4e")
    elif model is None:
        raise ValueError("give --model RUN, or --baseline NAME (see derender embed --help)")
    else:
        net, origin = open_model(model, device, fit_steps), {"source": model}
    with (
        _opened(data, dataset, part, limit, model, net.image_size) as source,
        progress_bar("embedding") as report,
    ):
        done = embed_to_file(
            net,
            source,
            out,
            batch_size=batch_size,
            fresh=force,
            progress=report,
            origin=origin,
            engine=None
            if engine == "local"
            else ray_engine(
                net, partial(open_images, data, dataset=dataset, limit=limit), workers=workers or 2,
                batch_size=batch_size,
            ),
        )  # fmt: skip
        notice(_account(done, source))
    sizes = ", ".join(f"{name} {size}" for name, size in done.factors.items())
    result(f"{done.rows:,} rows in {out}: {sizes}", json_file)
    write_json(
        json_file,
        {
            "out": out,
            "rows": done.rows,
            "factors": done.factors,
            "labels": done.labels,
            "origin": done.origin,
            "skipped": done.skipped,
            "copies": done.copies,
            "resumed": done.resumed,
        },
    )


def _check_engine(engine: str, workers: int | None, part: str) -> None:
    from derender.data import suggestion

    if engine not in ENGINES:
        raise ValueError(f"no engine {engine!r}{suggestion(engine, ENGINES)}: choose {' or '.join(ENGINES)}")
    if engine == "local" and workers is not None:
        raise ValueError("--workers belongs to --engine ray: leave it out, every core is used")
    if engine == "ray" and part != "all":
        raise ValueError("--engine ray embeds all of a data set: leave --part out")


@contextmanager
def _opened(
    data: str, dataset: str, part: str, limit: int | None, model: str | None, image_size: int
) -> "Iterator[Stream | PictureSet]":
    """The pictures as a stream; those of one part of a split, which has to know them all first, as a set."""
    from derender.data import open_images, read_pictures

    if part == "all":
        with open_images(data, dataset=dataset, limit=limit) as stream:
            yield stream
        return
    from derender.cli.models import part_of

    with progress_bar("reading") as report:
        pictures = read_pictures(data, image_size, dataset=dataset, limit=limit, progress=report)
    report_images(pictures)
    if pictures.terms:
        notice(f"on its owners' terms: {pictures.terms}")
    yield part_of(pictures, part, model)


def _account(done: "Embedded", source: "Stream | PictureSet") -> str:
    """One line: how many pictures of what, and what was left out or had been there."""
    noun = "picture" if done.rows == 1 else "pictures"
    parts = [f"{done.rows:,} {noun} from {source.source} ({source.layout})"]
    if done.resumed:
        parts.append(f"{done.resumed:,} of them from the run before")
    if done.skipped:
        parts.append(f"{done.skipped:,} skipped")
    if done.copies:
        parts.append(f"{done.copies:,} identical copies dropped")
    named = (f"skipped {visible(row.file, '')}: {row.reason}" for row in done.examples[:NAMED])
    return "\n".join([", ".join(parts), *named])
