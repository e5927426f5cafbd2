"""`derender evaluate disentangle`: does each feature hold its own factor, and only that?"""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import progress_bar, refuse_existing_file, report_images, result
from derender.cli.gathered import gathered


def register(group: typer.Typer) -> None:
    group.command(
        "disentangle",
        epilog="Example: derender evaluate disentangle --model runs/faces --data made/ --out card.png",
    )(disentangle)


@gathered
def disentangle(
    model: options.Model,
    data: options.Data,
    published: scoring.Published,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Draw all matrices into this picture.", metavar="FILE.png"),
    ] = None,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = 2000,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, max=20, metavar="N", help="Repeat with so many seeds.")
    ] = 3,
    swap_pictures: Annotated[
        int, typer.Option("--swap-pictures", min=2, metavar="N", help="At most so many in the swap test.")
    ] = 256,
    dimensions: Annotated[
        str,
        typer.Option("--dimensions", help="Scores by dimension: lasso, trees (takes minutes), or none."),
    ] = "lasso",
    batch_size: options.BatchSize = 64,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
) -> None:
    """Does each feature hold its own factor? Correlation, CKA, swap test; on rendered data DCI, MIG, SAP."""
    if dimensions not in ("lasso", "trees", "none"):
        raise ValueError(f"unknown --dimensions {dimensions!r}: choose lasso, trees or none")
    if out is not None:
        if out.suffix.lower() != ".png":
            raise ValueError(f"--out {out} must end in .png: the matrices are drawn as a PNG picture")
        refuse_existing_file(out, published.force)
    published.check()
    from derender.cli.models import open_model, part_of
    from derender.data import read_pictures
    from derender.evaluation.disentanglement import evaluate_disentanglement, left_out
    from derender.report import tables_disentanglement as tables

    net, memory = open_model(model, device), feature_rows.memory_in(cache)
    with progress_bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    pictures = part_of(pictures, part, model)
    report_images(pictures)
    with progress_bar("scoring", "steps") as report:
        card = evaluate_disentanglement(
            net,
            pictures,
            seeds=range(seed, seed + seeds),
            dimensions=None if dimensions == "none" else dimensions,
            swap_pictures=swap_pictures,
            batch_size=batch_size,
            memory=memory,
            progress=report,
        )
    summary = tables.summary_table(card)
    truth = (tables.truth_table(card), tables.dimension_table(card), tables.factor_r2_table(card))
    shown = [summary, *tables.swap_tables(card), *(table for table in truth if table is not None)]
    places = {column.name: place for place, column in enumerate(summary.columns)}
    told = (("swap", "swap test"), ("decoded", "swap test, decoded"))
    notes = [f"{name}: {summary.verdict(places[column])}" for column, name in told]
    unasked = left_out(pictures.labels)
    notes += [f"left out of the true factors: {name} ({why})" for name, why in unasked.items()]
    if out is not None:
        from derender.report.matrices import card_matrices, matrix_sheet
        from derender.storage.atomic import atomic_file

        sheet = matrix_sheet(card_matrices(card), f"{model}: {card.n_pictures:,} pictures")
        with atomic_file(out) as temporary:
            sheet.save(temporary, "PNG")
        result(f"matrices in {out}", published.json_file)
    values = {
        "pictures": card.n_pictures,
        "features": dict(zip(card.features, card.dimensions, strict=True)),
        "seeds": list(range(seed, seed + seeds)),
        "left_out": unasked,
        "rows": card.numbers(),
    }
    published.show(shown, values, [*notes, scoring.remembered(memory)])
