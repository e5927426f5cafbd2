"""`derender demo`: the whole story on built-in data, ending with the name of one report."""

import time
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import duration, notice, progress_bar, result, show_scores, write_json


def register(app: typer.Typer) -> None:
    app.command("demo", epilog="Example: derender demo --quick")(demo)


def demo(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="New folder for everything it makes.", metavar="DIR")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="About one minute: to see that it runs, not how good it is.")
    ] = False,
    seed: options.Seed = 0,
    json_file: options.Json = None,
) -> None:
    """Generate faces, train on them without labels, score unseen ones, write one page. Offline."""
    began = time.monotonic()
    notice("taking faces apart, learned from scratch on this machine" + (" (quick)" if quick else ""))
    from derender.demo import FULL, QUICK, demo_page, run_demo
    from derender.demo.page import score_tables
    from derender.training.process import TrainingInterrupted

    folder = out or _free_folder(Path("derender-demo"))
    try:
        with progress_bar("starting", "") as report:

            def show(stage: str, done: int, total: int, note: str) -> None:
                report(done, total, note, description=stage)

            told = run_demo(folder, QUICK if quick else FULL, seed=seed, report=show)
            show("writing the report", 0, 1, "")
            page = demo_page(told).write(folder / "report.html")
            show("writing the report", 1, 1, "")
    except TrainingInterrupted as stop:
        raise KeyboardInterrupt(
            f"stopped; run derender demo again to start over ({folder} can be deleted)"
        ) from stop
    tables = score_tables(told)
    for table in tables.values():
        show_scores(table, json_file)
        result("", json_file)
    for finding in told.trained.findings:
        notice(f"{finding.sign}: {finding.text}; {finding.advice}")
    notice(f"done in {duration(time.monotonic() - began)}; the model is in {told.trained.folder}")
    result(f"report {page}", json_file)
    write_json(
        json_file,
        {"report": page, "run": told.trained, "seconds": told.seconds}
        | {name: table.values() for name, table in tables.items()},
    )


def _free_folder(wanted: Path) -> Path:
    """The folder itself, or with the first number behind it that is not taken."""
    folder, number = wanted, 2
    while folder.exists():
        folder, number = wanted.with_name(f"{wanted.name}-{number}"), number + 1
    return folder
