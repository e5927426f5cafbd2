"""`derender demo`: the whole story on built-in data, ending with the name of one report."""

import time
from itertools import count
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import duration, notice, progress_bar, result, show_scores, write_json
from derender.cli.gathered import command

Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="New folder for everything it makes.", metavar="DIR")
]
QUICK_HELP = "About one minute: to see that it runs, not how good it is."


@command("demo", "demo --quick")
def demo(
    out: Out = None,
    quick: Annotated[bool, typer.Option("--quick", help=QUICK_HELP)] = False,
    seed: options.Seed = 0,
    json_file: options.Json = None,
) -> None:
    """Generate faces, train on them without labels, score unseen ones, write one page. Offline."""
    began = time.monotonic()
    notice("decomposing faces, learned from scratch on this machine" + (" (quick)" if quick else ""))
    from derender.demo import FULL, QUICK, demo_page, run_demo
    from derender.demo.page import score_tables
    from derender.training.process import TrainingInterrupted

    names = (f"derender-demo{f'-{number}' if number > 1 else ''}" for number in count(1))
    folder = out or next(Path(name) for name in names if not Path(name).exists())
    try:
        with progress_bar("starting", "") as report:
            told = run_demo(
                folder, QUICK if quick else FULL, seed=seed,
                report=lambda stage, done, total, note: report(done, total, note, description=stage),
            )  # fmt: skip
            page = demo_page(told).write(folder / "report.html")
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
    values = {name: table.values() for name, table in tables.items()}
    write_json(json_file, {"report": page, "run": told.trained, "seconds": told.seconds, **values})
