"""`derender embed`: one feature per factor for every picture, in one parquet file."""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import bar, out_of_the_way, result, say, write_json


def register(app: typer.Typer) -> None:
    app.command(
        "embed", epilog="Example: derender embed --model runs/faces --data photos/ --out features.parquet"
    )(embed)


def embed(
    model: options.Model,
    data: options.Data,
    out: Annotated[Path, typer.Option("--out", "-o", help="The table to write.", metavar="FILE.parquet")],
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    batch_size: options.BatchSize = 256,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a feature table: file, one list column per factor, and the labels of the data set."""
    out_of_the_way(out, force)
    from derender.cli.models import open_model, part_of
    from derender.data import read_pictures
    from derender.features import embed_pictures

    net = open_model(model, device)
    with bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    pictures = part_of(pictures, part, model)
    say(pictures.describe())
    with bar("embedding") as report:
        table = embed_pictures(
            net, pictures, batch_size=batch_size, progress=report, origin={"source": model}
        )
    table.write(out)
    sizes = {name: values.shape[1] for name, values in table.factors.items()}
    result(
        f"{len(table):,} rows in {out}: " + ", ".join(f"{name} {size}" for name, size in sizes.items()),
        json_file,
    )
    write_json(
        json_file,
        {
            "out": out,
            "rows": len(table),
            "factors": sizes,
            "labels": list(table.labels),
            "origin": table.origin,
        },
    )
