"""The common part of whiten, refine and unet: write a copy of a trained model, changed by means of images."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from derender.cli.console import progress_bar, report_images
from derender.cli.options import Output, PartOfImages, TrainedModel


def changes(help: str) -> Any:
    """The option ``--set`` with the names of its settings."""
    return typer.Option("--set", metavar="KEY=VALUE", help=help)


def copied(
    make: Callable[..., Any],
    doing: str,
    images: PartOfImages,
    model: TrainedModel,
    out: Path,
    output: Output,
    settings: list[str] | None,
    **more: Any,
) -> dict[str, Any]:
    """Make and report a copy by a call of `derender.learn`; gives its measurements by name."""
    output.refuse_existing(out)
    with progress_bar(doing) as report:
        made = make(
            model.model, images.address, out=out, settings=settings or (), device=model.device,
            overwrite=output.force, **images.how, on_images=report_images, progress=report, **more,
        )  # fmt: skip
    output.result(f"model {made.folder}")
    output.write(made.values())
    return made.scores
