"""`derender search`: the images of a table nearest to one image by one factor."""

from pathlib import Path

from derender.cli import options
from derender.cli.console import notice, progress_bar, show_scores
from derender.cli.options import command, option

LABELS_SHOWN = 4


@command("search", "search --features F.parquet --like a.jpg --model runs/faces --factor geometry")
def search(
    output: options.Output,
    features: str = option(..., "A table of derender embed.", "--features", "-f", metavar="FILE"),
    like: str = option(..., "An image, or the file name of a row of the table.", metavar="IMAGE"),
    factor: str = option("geometry", "Factor that has to be alike.", metavar="NAME"),
    k: int = option(12, "Number of rows to find.", "-k", min=1, metavar="N"),
    metric: str = option("cosine", "Distance: cosine or euclidean.", metavar="NAME"),
    copies: bool = option(False, "Find the image itself too, and copies of it.", "--copies"),
    model: str | None = option(None, "Model of the table.", "--model", "-m", metavar="MODEL"),
    out: Path | None = option(None, "Also draw the result.", "--out", "-o", metavar="FILE.png"),
    data: str | None = option(None, "New address of the table's images.", "--data", "-d", metavar="IMAGES"),
    dataset: options.Dataset = "auto", device: options.Device = "auto",
) -> None:  # fmt: skip
    """Find the same geometry under any lighting, the same lighting on anything: nearest by one factor."""
    output.check(out, ends=[".png"])
    import derender
    from derender.evaluation.score_table import Column, Row, ScoreTable

    how = {"metric": metric, "model": model, "copies": copies, "device": device}
    match = derender.search(features, like, factor, k, **how)
    files = match.table.files
    near = [
        {"row": row, "file": files[row], "distance": distance, "labels": match.labels(row)}
        for row, distance in zip(match.rows, match.distances, strict=True)
    ]
    shown = [name for name in match.table.labels if name != "partition"][:LABELS_SHOWN]
    columns = (Column("distance", digits=4), *map(Column, shown))
    rows = [Row(one["file"], (one["distance"], *(str(one["labels"][key]) for key in shown))) for one in near]
    caption = f"nearest to {like} by {factor}, {metric} distance, in {features} ({len(match.table):,} rows)"
    show_scores(ScoreTable(caption, "file", columns, rows), output.json_file)
    if match.unchecked:
        notice(f"{features} does not record which model made it: cannot check that it was {model}")
    if len(rows) < k:
        notice(f"the table has no more than {len(rows):,} {'rows' if copies else 'other rows'}")
    others = [] if copies else [files[row] for row in match.same_image if row != match.own_row]
    if others:
        more = f" and {len(others) - 1:,} more" if len(others) > 1 else ""
        notice(f"left out as the very same image: {others[0]}{more} (--copies finds it)")
    if out is not None:
        from derender.report.protocols import search_sheet

        with progress_bar("finding images") as report:
            left_out = search_sheet(match, out, data, dataset=dataset, progress=report)
        notice(*(f"left out of the sheet: {name} cannot be read" for name in left_out), f"drawn in {out}")
    asked = {"like": like, "factor": factor, "metric": metric, "table": features, "out": out}
    output.write({**asked, "same_picture": [files[row] for row in match.same_image], "found": near})
