"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from derender.cli.console import notice, progress_bar, result, show_scores, write_json

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
    """Do a plan, or continue it, and show the one table of each protocol."""
    from derender import learn
    from derender.learn.jobs import Comparison, jobs_of
    from derender.learn.plan import read_plan

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
    how = {"workers": planned.workers, "minutes": planned.minutes, "device": device}
    found = learn.compare_plan(plan, out, tell=notice, bar=progress_bar, **how)
    for table in found.tables:
        show_scores(table, json_file)
    for state in ("failed", "missing"):
        for sentence in found.values[state]:
            notice(f"{state}: {sentence}")
    if found.values["missing"]:
        notice("the budget is used; the same command continues where it stopped")
    for written in found.values["files"]:
        result(str(written), json_file)
    write_json(json_file, found.values)
