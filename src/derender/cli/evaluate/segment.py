"""`derender evaluate segment`: do pre-trained encoders help to find the parts of a face?"""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, result
from derender.cli.gathered import gathered

Masks = Annotated[
    str | None,
    typer.Option(
        "--masks",
        help="Folder or zip of masks named as the images, if they lie apart.",
        metavar="PATH",
    ),
]
Variants = Annotated[
    str | None,
    typer.Option("--variants", help="Networks to train, the subject first, with commas; default: all."),
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Epochs of every network.")]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Runs of every network.")]
BatchSize = Annotated[
    int | None,
    typer.Option("--batch-size", min=2, metavar="N", help="Images a step; default: 64, fewer of few images."),
]
TestFraction = Annotated[
    float,
    typer.Option("--test-fraction", min=0.01, max=0.99, help="Tested share of data without a partition."),
]
Labelled = Annotated[
    int | None,
    typer.Option("--labelled", min=2, metavar="N", help="Number of training images."),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Folder for runs (to continue) and overlays.", metavar="DIR"),
]


def register(group: typer.Typer) -> None:
    group.command(
        "segment",
        epilog="Example: derender evaluate segment CelebAMask-HQ/ --model runs/unet --out segmented/",
    )(segment)


@gathered
def segment(
    images: options.DataOptions,
    trained: options.TrainedModel,
    published: scoring.Published,
    masks: Masks = None,
    variants: Variants = None,
    epochs: Epochs = 20,
    seeds: Seeds = 3,
    batch_size: BatchSize = None,
    test_fraction: TestFraction = 0.2,
    labelled: Labelled = None,
    resamples: scoring.Resamples = 1_000,
    seed: options.Seed = 0,
    out: Out = None,
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
    names = None if variants is None else [name.strip() for name in variants.split(",") if name.strip()]
    with progress_bar("training") as report:
        scores = evaluation.segment(
            trained.open(), images.address, **images.how, masks=masks, test_fraction=test_fraction,
            labelled=labelled, variants=names, seeds=range(seed, seed + seeds), resample_count=resamples,
            settings=SegmentSettings(epochs=epochs, batch_size=batch_size), memory=memory, progress=report,
        )  # fmt: skip
    if out is not None:
        from derender.report.segmentation import write_overlays

        result(f"overlays {write_overlays(scores.result, out)}", published.json_file)
    values = {"model": trained.model, **scores.values}
    published.show(scores.tables, values, [*scores.notes, scoring.remembered(memory, "runs")])
