"""`derender evaluate segment`: do pre-trained encoders help to find the parts of a face?"""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import feature_rows, options
from derender.cli.console import bar, result, say, show_scores, write_json

ALL = "joint,geometry,albedo,joint-frozen,random,joint-random,joint-random-frozen"

Masks = Annotated[
    str | None,
    typer.Option(
        "--masks",
        help="Folder or zip of masks named as the pictures, if they are not with them.",
        metavar="PATH",
    ),
]
Variants = Annotated[
    str,
    typer.Option("--variants", help="Nets to train, with commas between; the first is what is asked."),
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Of every net.")]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Runs of every net.")]
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


def segment(
    model: options.Model,
    data: options.Data,
    masks: Masks = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    variants: Variants = ALL,
    epochs: Epochs = 20,
    seeds: Seeds = 3,
    batch_size: Annotated[int, typer.Option("--batch-size", min=2, metavar="N", help="Of training.")] = 64,
    test_fraction: TestFraction = 0.2,
    labelled: Labelled = None,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    out: Out = None,
    json_file: options.Json = None,
    markdown: feature_rows.Markdown = None,
    latex: feature_rows.Latex = None,
    force: options.Force = False,
) -> None:
    """Do pre-trained U-Net encoders help segmentation? mIoU, mIoU of the ten best classes, pixel accuracy.

    The model must have been trained with --set encoder=unet. Runs are kept in --out (without it, in the
    user's cache): the same command again goes on with the next run. Overlays show the pictures themselves:
    mind who is on them before you pass the folder on.
    """
    from derender.cli.models import open_model
    from derender.data import read_masks
    from derender.evaluation.memory import content_hash
    from derender.evaluation.segmentation import (
        SegmentSettings,
        chosen_variants,
        compare_segmentations,
        divide,
    )
    from derender.evaluation.segmentation.variants import check_encoders
    from derender.report.page import write_whole
    from derender.report.segmentation import segmentation_sheet
    from derender.report.tables_comparison import verdict_table
    from derender.report.tables_segmentation import (
        SEGMENT_COLUMNS,
        beside_the_paper,
        class_table,
        segmentation_table,
    )

    feature_rows.refuse_to_replace(force, markdown, latex)
    wanted = chosen_variants([name.strip() for name in variants.split(",") if name.strip()])
    net = open_model(model, device)
    check_encoders(net, wanted, model)
    with bar("reading") as report:
        if masks is None:
            read = read_masks(data, net.image_size, dataset=dataset, limit=limit, progress=report)
        else:
            from derender.data.mask_folder import read_mask_folder

            read = read_mask_folder(
                data, masks, net.image_size, dataset=dataset, limit=limit, progress=report
            )
    say(read.pictures.describe())
    divided = divide(*read, test_fraction=test_fraction, split_seed=seed, labelled=labelled)
    memory = feature_rows.memory_in(None if out is None else str(out / "runs"))
    with bar("training") as report:
        found = compare_segmentations(
            net,
            divided,
            wanted,
            tuple(range(seed, seed + seeds)),
            settings=SegmentSettings(epochs=epochs, batch_size=batch_size),
            resample_count=resamples,
            memory=memory,
            progress=report,
        )
    tables = [segmentation_table(found)]
    if any(row.scored.versus for row in found.rows):
        caption = "above the strongest control?"
        tables.append(verdict_table([row.scored for row in found.rows], SEGMENT_COLUMNS, caption))
    tables += [class_table(found), beside_the_paper(found)]
    for table in tables:
        show_scores(table, json_file)
    say(f"{memory.made} runs computed, {memory.recalled} found")
    if out is not None:
        answers = {row.scored.name: row.shown for row in found.rows if row.trainable}
        pictures, truth = divided.images[found.shown], divided.masks[found.shown]
        sheet = segmentation_sheet(pictures, truth, answers, found.classes)
        mark = content_hash({"pictures": pictures, "mask": truth, **answers})[:8]  # other answers, other file
        written = write_whole(out / f"overlays-{mark}.png", _png(sheet))
        result(f"overlays {written}", json_file)
    write_json(json_file, {"model": model, "data": read.pictures.source, **found.numbers()})
    feature_rows.write_tables(tables, markdown, latex)


def _png(image) -> bytes:
    import io

    stored = io.BytesIO()
    image.save(stored, "PNG")
    return stored.getvalue()
