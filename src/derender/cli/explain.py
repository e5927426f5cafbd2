"""`derender explain`: which factor made an answer, and where in the image it was seen."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import notice, progress_bar, refuse_existing, report_images, result
from derender.cli.gathered import command

LABEL = "Label column; several if each has two values."
Labels = Annotated[list[str] | None, typer.Option("--label", "-l", help=LABEL)]
Attributes = Annotated[bool, typer.Option("--attributes", help="Every yes/no label.")]
Bins = Annotated[int | None, typer.Option(min=2, help="Cut a column of numbers into N classes.", metavar="N")]
MinCount = Annotated[int, typer.Option(min=2, help="Leave out classes of fewer images.", metavar="N")]
OUT = "Folder for page, chart, sheets of maps and probe."
Out = Annotated[Path | None, typer.Option("--out", "-o", help=OUT, metavar="DIR")]
Seeds = Annotated[int, typer.Option(min=1, help="Number of probes to average over.", metavar="N")]
COUNT = "Number of images to learn from; default: 2 of 5."
Count = Annotated[int | None, typer.Option(min=2, help=COUNT, metavar="N")]
Groups = Annotated[str | None, typer.Option(help="Label whose rows stay together, such as identity.")]
Head = Annotated[str, typer.Option(help="logistic, or linear: the paper's head.")]
Target = Annotated[str, typer.Option("--output", help="Attributed output: logit or probability.")]
Start = Annotated[str, typer.Option(help="Start of the path: zero (the paper's) or mean.")]
SHEETS = "Number of labels to draw maps for, best first."
Sheets = Annotated[int, typer.Option(min=0, help=SHEETS, metavar="N")]
Rows = Annotated[int, typer.Option(min=2, help="Number of images on a sheet.", metavar="N")]
CLUSTERS = "Also explain the distance between N clusters."
Clusters = Annotated[int | None, typer.Option(min=2, help=CLUSTERS, metavar="N")]
PAIR = "Also explain the distance of these two images."
Pair = Annotated[tuple[str, str] | None, typer.Option("--pair", help=PAIR, metavar="FILE FILE")]


@command("explain", "explain celeba.zip --model runs/faces --attributes --out why/")
def explain(
    model: options.TrainedModel, images: options.PartOfImages, published: scoring.Published,
    label: Labels = None, attributes: Attributes = False, bins: Bins = None, min_count: MinCount = 2,
    out: Out = None, seeds: Seeds = 3, count: Count = None, groups: Groups = None, head: Head = "logistic",
    output: Target = "logit", baseline: Start = "zero", sheets: Sheets = 3, rows: Rows = 6,
    clusters: Clusters = None, pair: Pair = None, batch_size: options.BatchSize = 256, seed: options.Seed = 0,
) -> None:  # fmt: skip
    """Which factor made the answer, and where was it seen? Shares, maps, and controls for both."""
    if out is not None:
        refuse_existing(out, published.force)
    if bool(label) == attributes:
        raise ValueError("give either --label NAME (may be repeated) or --attributes")
    published.check()
    import derender
    from derender.report.explanation import write_explanation

    with progress_bar("explaining", "") as report:
        found = derender.explain(
            images.address, model.model, label or (), **images.how, bins=bins, min_count=min_count,
            seeds=seeds, count=count, groups=groups, head=head, output=output, baseline=baseline,
            clusters=clusters, pair=pair, batch_size=batch_size, seed=seed, device=model.device,
            progress=lambda stage: lambda done, total: report(done, total, description=stage),
        )  # fmt: skip
    report_images(found.images)
    if out is None:
        notice("add --out DIR for the page, the chart and maps over images")
    else:
        with progress_bar("drawing maps", "labels") as report:
            found = write_explanation(found, out, sheets=sheets, rows=rows, progress=report)
        result(f"report {out / 'explain.html'}", published.json_file)
    published.publish(replace(found.scores, values={**found.scores.values, "out": out}))
