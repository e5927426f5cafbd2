"""`derender evaluate segment`: do pre-trained encoders help to find the parts of a face?"""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, result

VARIANTS = "Networks to train, the subject first, with commas; default: all."
Variants = Annotated[str, typer.Option(help=VARIANTS)]
Epochs = Annotated[int, scoring.number(help="Epochs of every network.")]
Seeds = Annotated[int, scoring.number(help="Runs of every network.")]
BATCH = "Images a step; default: 64, fewer of few images."
BatchSize = Annotated[int | None, scoring.number(min=2, help=BATCH)]
Tested = Annotated[float, scoring.share(help="Tested share of data without a partition.")]
Labelled = Annotated[int | None, scoring.number(min=2, help="Number of training images.")]
OUT = "Folder for runs (to continue) and overlays."
Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help=OUT)]


def segment(
    images: options.DataOptions, trained: options.TrainedModel, published: scoring.Published,
    masks: scoring.Masks = None, variants: Variants = "all", epochs: Epochs = 20, seeds: Seeds = 3,
    batch_size: BatchSize = None, test_fraction: Tested = 0.2, labelled: Labelled = None,
    resamples: scoring.Resamples = 1_000, seed: options.Seed = 0, out: Out = None,
) -> None:  # fmt: skip
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
        from derender.report.protocols import write_overlays

        result(f"overlays {write_overlays(scores.result, out)}", published.json_file)
    published.publish(scores, memory, "runs", model=trained.model)
