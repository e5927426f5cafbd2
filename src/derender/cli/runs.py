"""Options and notices of the commands that train into a run folder: train and finetune."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import console

if TYPE_CHECKING:
    from derender.data import ImageSet
    from derender.training import Progress, TrainResult

OUT = "Run folder to make or to continue."
OutRun = Annotated[Path, typer.Option("--out", "-o", help=OUT, metavar="RUN")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the run in --out.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show all settings and stop.")]
PHASES = {
    "reading": ("reading", "images"),
    "train": ("training", "images"),
    "perceptual": ("perceptual features", "steps"),
    "features": ("whitening features", "images"),
    "refining": ("refining", "images"),
    "scoring": ("scoring", "heads"),
}


def dry_run_shown(config: Any, json_file: str | None) -> None:
    """Show all settings of a run."""
    from derender.training.config import to_yaml

    console.result(to_yaml(config).rstrip(), json_file)
    console.write_json(json_file, config.model_dump(mode="json"))


@contextmanager
def run_progress() -> Iterator[dict[str, Any]]:
    """A progress bar for a run, as keywords of the library call; what was read is noted, with its terms."""

    def show(progress: "Progress") -> None:
        speed = f"{progress.images_per_second:.0f} images/s, {progress.waiting:.1%} waiting for data"
        (description, unit), trains = PHASES[progress.phase], progress.phase == "train"
        report(progress.done, progress.total, speed if trains else "", description=description, unit=unit)

    from derender.data.doctor import quick_verdict

    def note(images: "ImageSet") -> None:
        console.report_images(images)
        if images.terms:
            console.notice(f"on its owners' terms: {images.terms}")
        if console.is_main_process() and (doubts := quick_verdict(images)):
            console.notice(f"the doctor: {doubts} (derender doctor has more)")

    with console.progress_bar("reading") as report:
        yield {"on_images": note, "progress": show}


def report_run(run: "TrainResult") -> None:
    """Note how a run ended."""
    console.notice(*(f"{one.sign}: {one.text}; {one.advice}" for one in run.findings))
    if run.stopped == "collapse":
        console.notice("training on is pointless: the last good checkpoint and model are kept, if any")
    took = f"{console.duration(run.seconds)}, {run.waiting:.1%} of it waiting for data"
    console.notice(f"{run.images:,} images in {took}; stopped by: {run.stopped}")
    if run.stopped != "collapse" and run.model_images not in (None, run.images):
        weights = f"the model has the weights of {run.model_images:,} images, the best on held-out ones"
        console.notice(f"{weights}; for those of the end: the same command with --resume --set keep=last")
