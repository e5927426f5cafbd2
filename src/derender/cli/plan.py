"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from derender.cli.console import notice, progress_bar, result, show_scores, write_json
from derender.cli.options import option

PLAN = "YAML or TOML file of methods and data sets to compare."
OUT = "Folder of --plan for runs, tables and charts; resumed."
MINUTES = "Minutes after which --plan scores what is finished."
PANEL = {"rich_help_panel": "Many methods on many data sets"}


@dataclass(frozen=True)
class Planned:
    """The options of a comparison by plan."""

    plan: Path | None = option(None, PLAN, metavar="FILE", **PANEL)
    out: Path | None = option(None, OUT, "--out", "-o", metavar="DIR", **PANEL)
    workers: int = option(1, "Number of jobs of --plan at a time.", min=1, metavar="N", **PANEL)
    minutes: float | None = option(None, MINUTES, min=0, metavar="M", **PANEL)
    dry_run: bool = option(False, "List the jobs of --plan, and stop.", "--dry-run", **PANEL)


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
    results = learn.compare_plan(plan, out, tell=notice, bar=progress_bar, **how)
    for table in results.tables:
        show_scores(table, json_file)
    for state in ("failed", "missing"):
        for sentence in results.values[state]:
            notice(f"{state}: {sentence}")
    if results.values["missing"]:
        notice("the budget is used; the same command continues where it stopped")
    for written in results.values["files"]:
        result(str(written), json_file)
    write_json(json_file, results.values)
