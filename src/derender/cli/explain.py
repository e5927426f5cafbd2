"""`derender explain`: which factor made an answer, and where in the image it was seen."""

from dataclasses import dataclass
from pathlib import Path

from derender.cli import options, scoring
from derender.cli.console import notice, progress_bar, report_images
from derender.cli.options import command, option
from derender.storage.atomic import require_replaceable

OUT = "Folder for page, chart, sheets of maps and probe."
PAIR = "Also explain the distance of these two images."


@dataclass(frozen=True)
class Asked:
    """The explained answers and how they are explained; named as in `derender.explain`."""

    bins: int | None = scoring.number(None, "Cut a column of numbers into N classes.", min=2)
    min_count: int = scoring.number(2, "Leave out classes of fewer images.", min=2)
    seeds: int = scoring.number(3, "Number of probes to average over.")
    count: int | None = scoring.number(None, "Number of images to learn from; default: 2 of 5.", min=2)
    groups: str | None = option(None, "Label whose rows stay together, such as identity.")
    head: str = option("logistic", "logistic, or linear: the paper's head.")
    output: str = option("logit", "Attributed output: logit or probability.")
    baseline: str = option("zero", "Start of the path: zero (the paper's) or mean.")
    clusters: int | None = scoring.number(None, "Also explain the distance between N clusters.", min=2)
    pair: tuple[str, str] | None = option(None, PAIR, metavar="FILE FILE")
    batch_size: options.BatchSize = 256
    seed: options.Seed = 0


@command("explain", "explain celeba.zip --model runs/faces --attributes --out why/")
def explain(
    model: options.TrainedModel, images: options.PartOfImages, published: scoring.Published, asked: Asked,
    label: list[str] | None = option(None, "Label column; several if each has two values.", "--label", "-l"),
    attributes: bool = option(False, "Every yes/no label.", "--attributes"),
    out: Path | None = option(None, OUT, "--out", "-o", metavar="DIR"),
    sheets: int = scoring.number(3, "Number of labels to draw maps for, best first.", min=0),
    rows: int = scoring.number(6, "Number of images on a sheet.", min=2),
) -> None:  # fmt: skip
    """Which factor made the answer, and where was it seen? Shares, maps, and controls for both."""
    if out is not None:
        published.check(out, folder=True)
        require_replaceable(out, True, "explain.html")
    if bool(label) == attributes:
        raise ValueError("give either --label NAME (may be repeated) or --attributes")
    import derender
    from derender.report.explanation import write_explanation

    with progress_bar("explaining", "") as report:
        results = derender.explain(
            images.address, model.model, label or (), **images.how, **vars(asked), device=model.device,
            progress=lambda stage: lambda done, total: report(done, total, description=stage),
        )  # fmt: skip
    report_images(results.images)
    if out is None:
        notice("add --out DIR for the page, the chart and maps over images")
    else:
        with progress_bar("drawing maps", "labels") as report:
            results = write_explanation(results, out, sheets=sheets, rows=rows, progress=report)
        published.result(f"report {out / 'explain.html'}")
    published.publish(results.scores, out=out)
