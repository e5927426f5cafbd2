"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored.

settings: the plan file; jobs: what a job is, and does; sweep: all jobs, workers and budget; outcome: tables,
charts, and what is missing.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from derender.cli.console import notice, result, show_scores, write_json

PLAN = "YAML or TOML file of methods and data sets to compare."
OUT = "Folder of --plan for runs, tables and charts; resumed."
WORKERS = "Number of jobs of --plan at a time."
MINUTES = "Minutes after which --plan scores what is finished."


def _option(*names: str, **how: Any) -> Any:
    return typer.Option(*names, rich_help_panel="Many methods on many data sets", **how)


@dataclass(frozen=True)
class Planned:
    """The options of a comparison by plan."""

    plan: Annotated[Path | None, _option("--plan", metavar="FILE", help=PLAN)] = None
    out: Annotated[Path | None, _option("--out", "-o", metavar="DIR", help=OUT)] = None
    workers: Annotated[int, _option("--workers", min=1, metavar="N", help=WORKERS)] = 1
    minutes: Annotated[float | None, _option("--minutes", min=0, metavar="M", help=MINUTES)] = None
    dry_run: Annotated[bool, _option("--dry-run", help="List the jobs of --plan, and stop.")] = False


def by_plan(planned: Planned, device: str, json_file: str | None) -> None:
    """Do a plan, or go on with it, and show the one table of each protocol."""
    from derender.cli.plan.jobs import Comparison, jobs_of
    from derender.cli.plan.outcome import write_outcome
    from derender.cli.plan.settings import read_plan
    from derender.cli.plan.sweep import do_all
    from derender.storage.atomic import atomic_file
    from derender.training.config import to_yaml

    plan, out = read_plan(str(planned.plan)), planned.out
    if planned.dry_run:
        notes = {job.name: out and Comparison(plan, out).note(job) for job in jobs_of(plan)}
        states = {name: note.state if note else "to do" for name, note in notes.items()}
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
    at = Comparison(plan, out, device)
    tables, values = write_outcome(at, do_all(at, planned.workers, planned.minutes))
    for table in tables:
        show_scores(table, json_file)
    for state in ("failed", "missing"):
        for sentence in values[state]:
            notice(f"{state}: {sentence}")
    if values["missing"]:
        notice("the budget is used; the same command goes on where it stopped")
    for written in values["files"]:
        result(str(written), json_file)
    write_json(json_file, values)
