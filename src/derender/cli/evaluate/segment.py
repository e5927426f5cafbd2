"""`derender evaluate segment`: do pre-trained encoders help to find the parts of a face?"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import notice, progress_bar, result
from derender.cli.gathered import gathered

if TYPE_CHECKING:
    import numpy as np

    from derender.data import PictureSet
    from derender.evaluation.memory import Memory
    from derender.evaluation.score_table import ScoreTable
    from derender.evaluation.segmentation import SegmentationComparison, SegmentationData

Masks = Annotated[
    str | None,
    typer.Option(
        "--masks",
        help="Folder or zip of masks named as the pictures, if they are not with them.",
        metavar="PATH",
    ),
]
Variants = Annotated[
    str | None,
    typer.Option(
        "--variants",
        help="Nets to train, with commas between; the first is what is asked. Default: all there are.",
    ),
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Of every net.")]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Runs of every net.")]
BatchSize = Annotated[
    int | None,
    typer.Option(
        "--batch-size", min=2, metavar="N", help="Of training; default: 64, fewer where pictures are few."
    ),
]
TestFraction = Annotated[
    float,
    typer.Option("--test-fraction", min=0.01, max=0.99, help="Tested, where the data have no partition."),
]
Labelled = Annotated[
    int | None, typer.Option("--labelled", min=2, metavar="N", help="Learn from so many pictures only.")
]
Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Folder for runs (to go on with) and overlays.", metavar="DIR"),
]


def register(group: typer.Typer) -> None:
    group.command(
        "segment",
        epilog="Example: derender evaluate segment --model runs/unet --data CelebAMask-HQ/ --out segmented/",
    )(segment)


@gathered
def segment(
    model: options.Model,
    data: options.Data,
    published: scoring.Published,
    masks: Masks = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    variants: Variants = None,
    epochs: Epochs = 20,
    seeds: Seeds = 3,
    batch_size: BatchSize = None,
    test_fraction: TestFraction = 0.2,
    labelled: Labelled = None,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    out: Out = None,
) -> None:
    """Do pre-trained U-Net encoders help segmentation? mIoU, mIoU of the ten best classes, pixel accuracy.

    The model must have U-Net encoders: derender unet makes a copy that has. Runs are kept in --out (without
    it, in the user's cache): the same command again goes on with the next run. Overlays show the pictures
    themselves: mind who is on them before you pass the folder on.
    """
    published.check()
    memory = feature_rows.memory_in(None if out is None else str(out / "runs"))
    run = segmented(
        model, MaskSource(data, masks, dataset, limit), variants, tuple(range(seed, seed + seeds)),
        memory, epochs=epochs, batch_size=batch_size, test_fraction=test_fraction, labelled=labelled,
        resamples=resamples, device=device,
    )  # fmt: skip
    if out is not None:
        result(f"overlays {write_overlays(run, out)}", published.json_file)
    values = {"model": model, "data": run.source, **run.found.numbers()}
    published.show(run.tables, values, [scoring.remembered(memory, "runs")])


@dataclass(frozen=True)
class MaskSource:
    """Where pictures and masks are read from."""

    data: str
    masks: str | None = None
    dataset: str = "auto"
    limit: int | None = None

    def read(self, image_size: int) -> "tuple[PictureSet, np.ndarray, tuple[str, ...]]":
        """Pictures, masks and the names of the classes."""
        from derender.data import read_masks

        own = {"dataset": self.dataset, "limit": self.limit}
        with progress_bar("reading") as report:
            if self.masks is None:
                return read_masks(self.data, image_size, progress=report, **own)
            return read_masks(self.data, image_size, masks=self.masks, progress=report, **own)


@dataclass(frozen=True)
class Segmented:
    """A comparison, what it was made on, and its tables."""

    found: "SegmentationComparison"
    divided: "SegmentationData"
    source: str
    differs: str
    tables: "list[ScoreTable]"


def segmented(
    model: str,
    pictures: MaskSource,
    variants: str | None,
    seeds: tuple[int, ...],
    memory: "Memory",
    *,
    epochs: int,
    batch_size: int | None = None,
    resamples: int,
    device: str,
    test_fraction: float = 0.2,
    labelled: int | None = None,
) -> Segmented:
    """Train every variant of a model's encoders on the masks, beside the controls; None: all it has."""
    from derender.cli.models import open_model
    from derender.evaluation.paper_tables import SEGMENTATION
    from derender.evaluation.segmentation import (
        SegmentSettings,
        chosen_variants,
        compare_segmentations,
        divide,
    )
    from derender.evaluation.segmentation.variants import check_encoders, usual_variants
    from derender.report.tables_segmentation import segmentation_tables

    named = None if variants is None else [name.strip() for name in variants.split(",") if name.strip()]
    wanted = {} if named is None else chosen_variants(named)
    net = open_model(model, device)
    wanted = wanted or usual_variants(net)
    check_encoders(net, wanted, model)
    read = pictures.read(net.image_size)
    notice(read[0].describe())
    divided = divide(*read, test_fraction=test_fraction, split_seed=seeds[0], labelled=labelled)
    with progress_bar("training") as report:
        found = compare_segmentations(
            net,
            divided,
            wanted,
            seeds,
            settings=SegmentSettings(epochs=epochs, batch_size=batch_size),
            resample_count=resamples,
            memory=memory,
            progress=report,
        )
    size = (
        f"+ {found.n_test:,} pictures at {net.image_size} x {net.image_size}, {len(found.classes)} classes,"
    )
    differs = SEGMENTATION.differs(read[0].layout, found.n_train, size)
    tables = segmentation_tables(found, differs)
    return Segmented(found, divided, read[0].source, differs, tables)


def write_overlays(run: Segmented, out: Path) -> Path:
    """The sheet of overlays; other answers are another file."""
    from derender.evaluation.memory import content_hash
    from derender.report.blocks import png_bytes
    from derender.report.page import write_whole
    from derender.report.segmentation import segmentation_sheet

    found = run.found
    answers = {row.scored.name: row.shown for row in found.rows if row.trainable}
    pictures, truth = run.divided.images[found.shown], run.divided.masks[found.shown]
    sheet = segmentation_sheet(pictures, truth, answers, found.classes)
    mark = content_hash({"pictures": pictures, "mask": truth, **answers})[:8]
    return write_whole(out / f"overlays-{mark}.png", png_bytes(sheet))
