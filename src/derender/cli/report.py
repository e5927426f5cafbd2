"""`derender report`: the page of a run, made again with everything that is available."""

from pathlib import Path
from typing import Annotated, Any

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar
from derender.cli.options import Output, command, option

Run = Annotated[Path, typer.Argument(help="Folder made by derender train.", metavar="RUN")]
LABEL = "Label to explain by factors. By default the first suitable one."


@command("report", "report runs/faces photos/ --out faces.html")
def report(
    run: Run, images: options.DataOptions, output: Output, device: options.Device = "auto",
    truth: str | None = option(None, "Rendered images with exact depth, to score geometry.", metavar="PATH"),
    label: list[str] | None = option(None, LABEL, "--label", "-l"),
    out: Path | None = option(None, "By default RUN/report.html, made anew.", "--out", "-o", metavar="FILE"),
) -> None:  # fmt: skip
    """Make the page of a run again, from its folder; with images also films, scores and explanations.

    The page holds images of the data: share it as you would the data itself.
    """
    from derender.report.run import Evidence, run_evidence, run_page

    if not (run / "config.yaml").is_file():
        raise FileNotFoundError(f"no run in {run} (no config.yaml): give a folder made by derender train")
    output.check(out)
    evidence, data = Evidence(), images.optional_address
    if data is not None:
        how: dict[str, Any] = {"truth": truth, "labels": label or (), "device": device, **images.how}
        with progress_bar("gathering", "parts") as progress:
            evidence = run_evidence(run, data, progress=progress, **how)
    elif truth is not None or label:
        raise ValueError("--truth and --label need images to report on")
    else:
        notice("add images for decompositions, films, scores, the disentanglement card and explanations")
    page = run_page(run, evidence).write(out or run / "report.html")
    notice(*(f"not on the page: {reason}" for reason in evidence.failed))
    output.result(f"report {page}")
    output.write({"report": page, "failed": evidence.failed})
