"""What `derender compare --plan` does, from the file to the last word."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from derender.cli.console import notice, result, show_scores, write_json

PANEL = "Many methods on many data sets"


@dataclass(frozen=True)
class Planned:
    """The options of a comparison by plan."""

    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan", metavar="FILE", rich_help_panel=PANEL,
            help="YAML or TOML file of methods and data sets to train, embed and score.",
        ),
    ] = None  # fmt: skip
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="DIR", rich_help_panel=PANEL,
            help="Folder of --plan for runs, tables and charts; an existing one is resumed.",
        ),
    ] = None  # fmt: skip
    workers: Annotated[
        int,
        typer.Option(
            "--workers", min=1, metavar="N", help="Number of jobs of --plan at a time.", rich_help_panel=PANEL
        ),
    ] = 1
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes", min=0, metavar="M", rich_help_panel=PANEL,
            help="Minutes after which --plan stops, and scores the finished jobs.",
        ),
    ] = None  # fmt: skip
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the jobs of --plan, and stop.", rich_help_panel=PANEL)
    ] = False


def by_plan(
    file: Path,
    out: Path | None,
    *,
    workers: int,
    minutes: float | None,
    device: str,
    dry_run: bool,
    json_file: str | None,
) -> None:
    """Do a plan, or go on with it, and show the one table of each protocol."""
    from derender.cli.plan import jobs
    from derender.cli.plan.outcome import write_outcome
    from derender.cli.plan.settings import read_plan
    from derender.cli.plan.sweep import Sweep, jobs_of
    from derender.storage.atomic import atomic_file
    from derender.training.config import to_yaml

    plan = read_plan(file)
    if dry_run:
        notes = {job.name: None if out is None else Sweep(plan, out).note(job) for job in jobs_of(plan)}
        states = {name: "to do" if note is None else note.state for name, note in notes.items()}
        for name, state in states.items():
            result(f"{name}: {state}", json_file)
        notice(", ".join(f"{count} {state}" for state, count in Counter(states.values()).items()))
        write_json(json_file, {"jobs": states, "plan": plan.model_dump(mode="json")})
        return
    if out is None:
        raise ValueError("--plan needs --out DIR: a folder for runs, tables and images")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file: give --out the name of a folder")
    if out.is_dir() and any(out.iterdir()) and not (out / "plan.yaml").is_file():
        raise ValueError(f"{out} is not empty and holds no comparison: choose another --out")
    with atomic_file(out / "plan.yaml") as temporary:
        temporary.write_text(to_yaml(plan))
    work = {"train": jobs.train, "embed": jobs.embed, "score": jobs.score}
    sweep = Sweep(plan, out, device, work)
    try:
        sweep.do_all(workers, minutes)
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("stopped and saved; the same command goes on where it stopped") from stop
    outcome = write_outcome(sweep)
    for table in outcome.tables:
        show_scores(table, json_file)
    for state, sentences in (("failed", outcome.failed), ("missing", outcome.missing)):
        for sentence in sentences:
            notice(f"{state}: {sentence}")
    if outcome.missing:
        notice("the budget is used; the same command goes on where it stopped")
    for written in outcome.files:
        result(str(written), json_file)
    values = {"out": out, "files": outcome.files, "failed": outcome.failed, "missing": outcome.missing}
    write_json(json_file, {**values, "tables": [table.values() for table in outcome.tables]})
