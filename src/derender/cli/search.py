"""`derender search`: the pictures of a table nearest to one picture by one factor."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing_file, visible, write_json

if TYPE_CHECKING:
    import numpy as np

    from derender.features import FeatureTable

LABELS_SHOWN = 4
CELL = 160


def register(app: typer.Typer) -> None:
    example = (
        "Example: derender search --features F.parquet --like a.jpg --model runs/faces --factor geometry"
    )
    app.command("search", epilog=example)(search)


def search(
    features: Annotated[
        str, typer.Option("--features", "-f", help="A table made by derender embed.", metavar="FILE.parquet")
    ],
    like: Annotated[
        str,
        typer.Option("--like", help="A picture, or the file name of a row of the table.", metavar="IMAGE"),
    ],
    factor: Annotated[
        str, typer.Option("--factor", help="What has to be alike.", metavar="NAME")
    ] = "geometry",
    k: Annotated[int, typer.Option("-k", min=1, metavar="N", help="How many to find.")] = 12,
    metric: Annotated[
        str, typer.Option("--metric", help="Distance: cosine or euclidean.", metavar="NAME")
    ] = "cosine",
    copies: Annotated[
        bool, typer.Option("--copies", help="Find the picture itself too, and copies of it.")
    ] = False,
    model: Annotated[
        str | None,
        typer.Option("--model", "-m", help="The model that made the table: for a picture.", metavar="MODEL"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Also draw what was found.", metavar="FILE.png")
    ] = None,
    data: Annotated[
        str | None,
        typer.Option(
            "--data", "-d", help="Where the table's pictures lie, if no longer where it says.", metavar="PATH"
        ),
    ] = None,
    dataset: options.Dataset = "auto",
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Find the same geometry in any light, the same light on anything: nearest by one factor, exactly."""
    if out is not None:
        refuse_existing_file(out, force)
        if out.suffix.lower() != ".png":
            raise ValueError(f"{out} is no PNG: give --out a name that ends in .png")
    from derender.features import FeatureTable
    from derender.features.search import nearest, same_picture

    table = FeatureTable.read(features, only=factor)
    codes, own_row = _query(table, features, like, factor, model, device)
    itself = same_picture(table, codes).tolist()
    hidden = [] if copies else itself
    if len(hidden) == len(table):
        raise ValueError(f"{features} has no row but {like} itself: add --copies to find that")
    found = nearest(table, codes[factor], factor, k, metric=metric, exclude=hidden)
    rows, distances = found.rows[0].tolist(), found.distances[0].tolist()
    labels = [name for name in table.labels if name != "partition"][:LABELS_SHOWN]
    where = f"in {features} ({len(table):,} rows)"
    _show(
        f"nearest to {like} by {factor}, {metric} distance, {where}",
        ["", "distance", "file", *labels],
        [
            [
                str(place),
                f"{distance:.4f}",
                table.files[row],
                *(str(table.labels[name][row]) for name in labels),
            ]
            for place, (row, distance) in enumerate(zip(rows, distances, strict=True), 1)
        ],
        json_file,
    )
    if len(rows) < k:
        notice(f"the table has no more than {len(rows):,} {'rows' if copies else 'other rows'}")
    others = [table.files[row] for row in hidden if row != own_row]
    if others:
        more = f" and {len(others) - 1:,} more" if len(others) > 1 else ""
        notice(f"left out as the very same picture: {others[0]}{more} (--copies finds it)")
    if out is not None:
        _draw(out, table, rows, distances, like, own_row, data, dataset, f"nearest by {factor}")
        notice(f"drawn in {out}")
    write_json(
        json_file,
        {
            "like": like,
            "factor": factor,
            "metric": metric,
            "table": features,
            "same_picture": [table.files[row] for row in itself],
            "found": [
                {
                    "row": row,
                    "file": table.files[row],
                    "distance": distance,
                    "labels": {name: values[row] for name, values in table.labels.items()},
                }
                for row, distance in zip(rows, distances, strict=True)
            ],
            "out": out,
        },
    )


def _show(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], json_file: str | None) -> None:
    """A table of text where results go, as wide as it is where that is no terminal."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(
            column, justify="right" if column in ("", "distance") else "left", header_style="dim"
        )
    for row in rows:
        table.add_row(*(escape(visible(cell, "")) for cell in row))
    console = Console(stderr=json_file == "-", highlight=False)
    if not console.is_terminal:
        widest = console.options.update(max_width=10_000)
        console.width = max(console.width, console.measure(table, options=widest).maximum)
    console.print(visible(title), markup=False, soft_wrap=True)
    console.print(table, crop=False)


def _query(
    table: "FeatureTable", features: str, like: str, factor: str, model: str | None, device: str
) -> "tuple[dict[str, np.ndarray], int | None]":
    """The features to look for by factor, and the row they have in the table if it is one of its rows.

    With a model the name means a file first; without one it means a row.
    """
    row = table.files.index(like) if like in table.files else None
    if row is not None and (model is None or not Path(like).is_file()):
        return {name: rows[row] for name, rows in table.factors.items()}, row
    if model is None:
        from derender.data import suggestion

        known = table.files if len(table) <= 2_000 else ()
        hint = "; to search with a picture, add --model" if Path(like).is_file() else suggestion(like, known)
        raise ValueError(f"{features} has no row {like!r}{hint}; its first is {table.files[0]!r}")
    from derender.cli.models import check_maker, open_model
    from derender.features import embed_images
    from derender.report.opening import read_file

    net = open_model(model, device)
    net = check_maker(net, model, table, features)
    codes = embed_images(net, read_file(Path(like), net.image_size)[None])
    if factor not in codes:
        raise ValueError(f"{model} makes no {factor!r}; it makes {', '.join(codes)}")
    return {name: rows[0] for name, rows in codes.items()}, None


def _draw(
    out: Path,
    table: "FeatureTable",
    rows: Sequence[int],
    distances: Sequence[float],
    like: str,
    own_row: int | None,
    data: str | None,
    dataset: str,
    title: str,
) -> None:
    """A contact sheet: the query, then what was found; what cannot be read is left out and named."""
    from derender.report.colours import pictures
    from derender.report.opening import read_file
    from derender.report.panel import GridLayout, contact_sheet
    from derender.storage.atomic import atomic_file

    source = data if data is not None else str(table.origin.get("data", ""))
    wanted = [*(() if own_row is None else (own_row,)), *rows]
    read = _pictures_of([table.files[row] for row in wanted], source, dataset)
    captions = {row: f"{distance:.3f}" for row, distance in zip(rows, distances, strict=True)}
    shown: list[tuple[str, Any]] = []
    if own_row is None:
        shown.append(("query", read_file(Path(like), CELL)))
    for row in wanted:
        if table.files[row] in read:
            shown.append((captions.get(row, "query"), read[table.files[row]]))
        else:
            notice(f"left out of the sheet: {table.files[row]} cannot be read from {source}")
    sheet = contact_sheet(
        [pictures(picture[None])[0] for _, picture in shown],
        [caption for caption, _ in shown],
        across=7,
        title=title,
        layout=GridLayout(cell=CELL),
    )
    with atomic_file(out) as temporary:
        sheet.save(temporary, format="PNG")


def _pictures_of(files: Sequence[str], source: str, dataset: str) -> "dict[str, np.ndarray]":
    """The pictures of these names, by name, as far as they can be read; nothing else is decoded."""
    if not source:
        raise ValueError("the table does not say where its pictures lie: give --data, or leave out --out")
    from derender.data import Unreadable, decode, open_images, quiet_pillow

    missing, read = set(files), {}
    with (
        open_images(source, dataset=dataset) as stream,
        progress_bar("finding pictures") as report,
        quiet_pillow(),
    ):
        for number, sample in enumerate(stream.samples(), 1):
            if sample.file in missing:
                missing.remove(sample.file)
                try:
                    read[sample.file] = decode(sample.read(), CELL, box=sample.box)
                except (Unreadable, ValueError, OSError):
                    continue
                report(len(read), len(files), note=f"{number:,} looked at")
            if not missing:
                break
    if not read:
        raise ValueError(
            f"{source} holds none of the pictures found, such as {files[-1]!r}: give another --data"
        )
    return read
