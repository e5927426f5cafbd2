"""`derender report`: the page of a run, made again with everything that is at hand."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing_file, report_images, result, write_json

if TYPE_CHECKING:
    from derender.data import GroundTruth, PictureSet
    from derender.report.evidence import Evidence

TRUTH_PICTURES = 100


def register(app: typer.Typer) -> None:
    app.command(
        "report", epilog="Example: derender report runs/faces --data photos/ --out faces.html"
    )(report)  # fmt: skip


def report(
    run: Annotated[Path, typer.Argument(help="Folder made by derender train.", metavar="RUN")],
    data: Annotated[
        str | None,
        typer.Option(
            "--data",
            "-d",
            help="Pictures to tell about: those it was trained with, or others.",
            metavar="PATH",
        ),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            "--truth", help="Rendered pictures with exact depth, to score geometry.", metavar="PATH"
        ),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(
            "--label", "-l", help="Which factor answers this label? By default the first that suits."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="By default RUN/report.html, made anew.", metavar="FILE.html"),
    ] = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Make the page of a run again, from its folder; with --data also films, scores and explanations.

    The page holds pictures of the data: share it as you would the data itself.
    """
    from derender.report.run import run_page

    if not (run / "config.yaml").is_file():
        raise FileNotFoundError(f"no run in {run} (no config.yaml): give a folder made by derender train")
    if out is not None:
        refuse_existing_file(out, force)
    if data is None and (truth is not None or label):
        raise ValueError("--truth and --label need --data: pictures to tell about")
    evidence = None
    if data is None:
        notice("add --data for decompositions, films, scores, the disentanglement card and explanations")
    else:
        evidence = _evidence(run, data, truth, label or [], dataset, limit, device)
    page = run_page(run, evidence).write(out or run / "report.html")
    failed = [] if evidence is None else list(evidence.failed)
    for reason in failed:
        notice(f"not on the page: {reason}")
    result(f"report {page}", json_file)
    write_json(json_file, {"report": page, "failed": failed})


def _evidence(
    run: Path, data: str, truth: str | None, labels: list[str], dataset: str, limit: int | None, device: str
) -> "Evidence":
    """What there is to tell; a run that has no model of ours can only have its data examined."""
    from derender.cli.models import open_model
    from derender.data import read_pictures
    from derender.data.doctor import EXAMINED_PX
    from derender.report.evidence import AtHand, Evidence, gather, look_at_data
    from derender.report.page import Section

    try:
        net, missing = open_model(str(run), device), ""
    except (ValueError, FileNotFoundError) as reason:  # a baseline, a collapse, a run that just began
        net, missing = None, f"Everything about the model: {reason}"
    with progress_bar("reading") as progress:
        size = EXAMINED_PX if net is None else net.image_size
        pictures = read_pictures(data, size, dataset=dataset, limit=limit, progress=progress)
    report_images(pictures)
    for name in labels:
        pictures.label(name)
    if net is None:
        return Evidence([Section("The data", look_at_data(pictures), "Data")], [missing])
    held_out, which = _held_out(run, pictures)
    known = _truth(truth, net.image_size)
    with progress_bar("gathering", "parts") as progress:
        return gather(AtHand(net, pictures, held_out, which, known, labels), progress)


def _held_out(run: Path, pictures: "PictureSet") -> "tuple[PictureSet, str]":
    """What the run did not learn from, if these are its own pictures; otherwise all."""
    from derender.baselines import read_any_config
    from derender.data import split_indices
    from derender.report.run import trained_pictures

    config = read_any_config(run)
    if len(pictures) != trained_pictures(run):
        return (
            pictures,
            f"All {len(pictures):,} pictures of {pictures.source}; the run was trained with others",
        )
    split = split_indices(pictures.files, config.split, seed=config.seed)
    for name in ("test", "validation"):
        rows = getattr(split, name)
        if len(rows):
            return pictures.select(rows), f"The {len(rows):,} pictures of the run's {name} part"
    return pictures, "The very pictures it was trained with, for it held none back"


def _truth(source: str | None, size: int) -> "GroundTruth | None":
    from derender.data import read_ground_truth

    return None if source is None else read_ground_truth(source, limit=TRUTH_PICTURES, image_size=size)
