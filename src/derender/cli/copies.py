"""`derender whiten`, and the part it shares with refine and unet: a copy of a model, changed by images."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from typer import Exit

from derender.cli.console import notice, progress_bar, refuse_existing, report_images
from derender.cli.options import OutModel, Output, PartOfImages, Seed, Settings, TrainedModel, command
from derender.cli.runs import DryRun, dry_run_shown


def copied(
    make: Callable[..., Any], doing: str, images: PartOfImages, model: TrainedModel, out: Path,
    output: Output, settings: list[str] | None, dry_run: bool, **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """Make and report a copy by a call of `derender.learn`; gives its measurements by name."""
    from derender import learn

    if dry_run:
        dry_run_shown(learn.copy_settings(make.__name__, settings or ()), output.json_file)
        raise Exit
    refuse_existing(out, output.force)
    with progress_bar(doing) as report:
        made = make(
            model.model, images.address, out=out, settings=settings or (), device=model.device,
            overwrite=output.force, **images.how, on_images=report_images, progress=report, **more,
        )  # fmt: skip
    output.result(f"model {made.folder}")
    output.write(made.values())
    return made.scores


@command("whiten", "whiten photos/ --model rendered-faces-64 --out mine")
def whiten(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Settings = None,
    seed: Seed = 0, dry_run: DryRun = False,
) -> None:  # fmt: skip
    """Write a copy of a model whose features move as little as possible with other factors.

    They are estimated on these images, without labels, and so is how albedo and lighting share brightness.
    Weights and reconstructions stay as they are. Training ends with this by itself. With --set steps=20
    features also hold scenes optimised for each image by rendering.
    """
    from derender import learn

    scores = copied(learn.whiten, "re-rendering", images, model, out, output, settings, dry_run, seed=seed)
    for name, ratios in scores["between_over_within"].items():
        clear = sum(ratio > 1 for ratio in ratios)
        differ = f"in {clear} images differ more than one does where other factors change"
        notice(f"{name}: {len(ratios)} directions kept; {differ}")
