"""`derender evaluate segment` and `disentangle`: do encoders help, and do features hold one factor each?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from derender.cli import options, scoring
from derender.cli.options import command, option

OUT = "Folder for runs (to continue) and overlays."


@command("segment", "evaluate segment CelebAMask-HQ/ --model runs/unet --out segmented/", scoring.evaluate)
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
    published.publish(scores, model=trained.model, half=images.half)


@dataclass(frozen=True)
class CardImages(options.PartOfImages):
    """The images of the card."""

    limit: options.Limit = 2000


@command("disentangle", "evaluate disentangle made/ --model runs/faces --out card.png", scoring.evaluate)
def disentangle(
    images: CardImages, trained: options.TrainedModel, published: scoring.Published,
    out: Path | None = option(None, "PNG file for all matrices.", "--out", "-o", metavar="FILE.png"),
    seeds: int = scoring.number(3, "Number of seeds.", max=20),
    swap_pictures: int = scoring.number(256, "Most images in the swap test.", min=2),
    dimensions: Literal["lasso", "none"] = option("lasso", "Scores by dimension: lasso or none."),
    batch_size: options.BatchSize = 128, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Does each feature hold its own factor? Correlation, CKA, swap test; on rendered data DCI, MIG, SAP."""
    published.check(out, ends=[".png"])
    model = trained.open()
    chosen = images.read(model.image_size, model=trained.model)
    scores = scoring.measured(
        "disentangle", model, chosen, seeds=range(seed, seed + seeds), swap_images=swap_pictures,
        dimensions=None if dimensions == "none" else dimensions, batch_size=batch_size, cache=cache,
        unit="steps",
    )  # fmt: skip
    if out is not None:
        from derender.report.charts import write_card

        write_card(scores.result, f"{trained.model}: {len(chosen):,} images", out)
        published.result(f"matrices in {out}")
    published.publish(scores, half=images.half)
