"""The options of `embed` for baselines, and the tables of those without a network."""

from pathlib import Path
from typing import Annotated

import typer

from derender.baselines.registry import BASELINES
from derender.cli.console import progress_bar, report_images, result, write_json

PANEL = "Baselines"
BaselineName = Annotated[
    str | None,
    typer.Option(
        "--baseline",
        help=f"Instead of our model: {', '.join(BASELINES)}.",
        metavar="NAME",
        rich_help_panel=PANEL,
    ),
]
BaselineFeatures = Annotated[
    str | None,
    typer.Option(
        "--features",
        help="Which of a baseline's features, with commas between.",
        metavar="A,B",
        rich_help_panel=PANEL,
    ),
]
BaselineCheckpoint = Annotated[
    str | None,
    typer.Option(
        "--checkpoint",
        help="Instead of --model, of e4e: a published file such as e4e_ffhq_encode.pt.",
        metavar="FILE",
        rich_help_panel=PANEL,
    ),
]
BaselineImageSize = Annotated[
    int,
    typer.Option(
        "--image-size",
        min=8,
        help="Side in pixels, for those without a network of a fixed size.",
        metavar="N",
        rich_help_panel=PANEL,
    ),
]
BaselineComponents = Annotated[
    int, typer.Option("--components", min=1, help="Of pca and noise.", metavar="N", rich_help_panel=PANEL)
]
BaselineSeed = Annotated[
    int,
    typer.Option("--seed", min=0, help="Of pca, noise and untrained.", metavar="N", rich_help_panel=PANEL),
]


def write_control(
    name: str,
    data: str,
    out: Path,
    *,
    dataset: str,
    part: str,
    limit: int | None,
    model: str | None,
    image_size: int,
    components: int,
    seed: int,
    json_file: str | None,
) -> None:
    """Write the table of a control; PCA is fitted on the training part where ``part`` is not all."""
    from derender.baselines import control_features
    from derender.cli.models import part_of
    from derender.data import read_pictures

    with progress_bar("reading") as report:
        pictures = read_pictures(data, image_size, dataset=dataset, limit=limit, progress=report)
    chosen = part_of(pictures, part, model)
    fit_on = pictures if part == "all" else part_of(pictures, "train", model)
    report_images(chosen)
    with progress_bar("describing") as report:
        table = control_features(
            name, chosen, fit_on=fit_on, components=components, seed=seed, progress=report
        )
    table.write(out)
    sizes = {factor: values.shape[1] for factor, values in table.factors.items()}
    told = ", ".join(f"{factor} {size}" for factor, size in sizes.items())
    result(f"{len(table):,} rows in {out}: {told}", json_file)
    values = {"out": out, "rows": len(table), "factors": sizes, "labels": list(table.labels)}
    write_json(json_file, {**values, "origin": table.origin})
