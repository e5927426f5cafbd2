"""`derender evaluate segment`: do pre-trained encoders help to find the parts of a face?"""

from pathlib import Path

from derender.cli import options, scoring
from derender.cli.options import option

OUT = "Folder for runs (to continue) and overlays."


def segment(
    images: options.DataOptions, trained: options.TrainedModel, published: scoring.Published,
    masks: scoring.Masks = None,
    variants: str = option("all", "Networks to train, the subject first, with commas; default: all."),
    epochs: int = scoring.number(20, "Epochs of every network."),
    seeds: int = scoring.number(3, "Runs of every network."),
    batch_size: int | None = scoring.number(None, "Images a step; default: 64, fewer of few images.", min=2),
    test_fraction: float = scoring.share(0.2, "Tested share of data without a partition."),
    labelled: int | None = scoring.number(None, "Number of training images.", min=2),
    resamples: scoring.Resamples = 1_000, seed: options.Seed = 0,
    out: Path | None = option(None, OUT, "--out", "-o", metavar="DIR"),
) -> None:  # fmt: skip
    """Do pre-trained U-Net encoders help segmentation? mIoU, mIoU of the ten best classes, pixel accuracy.

    The model must have U-Net encoders: derender unet makes a copy that has. Runs are cached in --out (without
    it, in the user's cache): the same command continues with the next run. Overlays show the images
    themselves: consider who is on them before you share the folder.
    """
    from derender.evaluation.segmentation import SegmentSettings

    scores = scoring.measured(
        "segment", trained.open(), images.address, **images.how, masks=masks, test_fraction=test_fraction,
        labelled=labelled, variants=scoring.names_of(variants), seeds=range(seed, seed + seeds),
        resamples=resamples, settings=SegmentSettings(epochs=epochs, batch_size=batch_size),
        cache=None if out is None else out / "runs", doing="training",
    )  # fmt: skip
    if out is not None:
        from derender.report.protocols import write_overlays

        published.result(f"overlays {write_overlays(scores.result, out)}")
    published.publish(scores, model=trained.model)
