"""`derender evaluate segment`: do pre-trained encoders help to find the parts of a face?"""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, result


def segment(
    images: options.DataOptions,
    trained: options.TrainedModel,
    published: scoring.Published,
    masks: scoring.Masks = None,
    variants: Annotated[
        str, typer.Option(help="Networks to train, the subject first, with commas; default: all.")
    ] = "all",
    epochs: Annotated[int, scoring.number(help="Epochs of every network.")] = 20,
    seeds: Annotated[int, scoring.number(help="Runs of every network.")] = 3,
    batch_size: Annotated[
        int | None, scoring.number(min=2, help="Images a step; default: 64, fewer of few images.")
    ] = None,
    test_fraction: Annotated[float, scoring.share(help="Tested share of data without a partition.")] = 0.2,
    labelled: Annotated[int | None, scoring.number(min=2, help="Number of training images.")] = None,
    resamples: scoring.Resamples = 1_000,
    seed: options.Seed = 0,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder for runs (to continue) and overlays."),
    ] = None,
) -> None:
    """Do pre-trained U-Net encoders help segmentation? mIoU, mIoU of the ten best classes, pixel accuracy.

    The model must have U-Net encoders: derender unet makes a copy that has. Runs are cached in --out (without
    it, in the user's cache): the same command continues with the next run. Overlays show the images
    themselves: consider who is on them before you share the folder.
    """
    published.check()
    from derender import evaluation
    from derender.evaluation.memory import memory_in
    from derender.evaluation.segmentation import SegmentSettings

    memory = memory_in(None if out is None else str(out / "runs"))
    with progress_bar("training") as report:
        scores = evaluation.segment(
            trained.open(), images.address, **images.how, masks=masks, test_fraction=test_fraction,
            labelled=labelled, variants=scoring.names_of(variants), seeds=range(seed, seed + seeds),
            resample_count=resamples, settings=SegmentSettings(epochs=epochs, batch_size=batch_size),
            memory=memory, progress=report,
        )  # fmt: skip
    if out is not None:
        from derender.report.segmentation import write_overlays

        result(f"overlays {write_overlays(scores.result, out)}", published.json_file)
    published.publish(scores, memory, "runs", model=trained.model)
