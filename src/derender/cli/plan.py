"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored."""

from dataclasses import dataclass
from pathlib import Path

from derender.cli.console import notice, progress_bar, result, show_scores, write_json
from derender.cli.options import option

PLAN = "YAML or TOML file of methods and data sets to compare."
OUT = "Folder of --plan for runs and tables; resumed."
PANEL = {"rich_help_panel": "Many methods on many data sets"}


@dataclass(frozen=True)
class Planned:
    """The options of a comparison by plan."""

    plan: Path | None = option(None, PLAN, metavar="FILE", **PANEL)
    out: Path | None = option(None, OUT, "--out", "-o", metavar="DIR", **PANEL)
    dry_run: bool = option(False, "List the jobs of --plan, and stop.", "--dry-run", **PANEL)
    workers: int | None = option(None, None, hidden=True)  # of earlier commands; jobs follow one another
    minutes: float | None = option(None, None, hidden=True)  # likewise: a stopped plan continues


def by_plan(planned: Planned, device: str, json_file: str | None) -> None:
    """Do a plan, or continue it, and show the summary of each protocol."""
    from derender import learn
    from derender.learn.sweep import read_plan, states_of

    plan, out = read_plan(str(planned.plan)), planned.out
    if planned.dry_run:
        states = states_of(plan, out)
        for job, state in states.items():
            result(f"{job}: {state}", json_file)
        write_json(json_file, {"jobs": states, "plan": plan.model_dump(mode="json")})
        return
    if out is None:
        raise ValueError("--plan needs --out DIR: a folder for runs and tables")
    scores = learn.compare_plan(plan, out, device=device, tell=notice, bar=progress_bar)
    for table in scores.tables[: scores.values["summaries"]]:
        show_scores(table, json_file)
    notice(*(f"failed: {sentence}" for sentence in scores.values["failed"]))
    for file in scores.values["files"]:
        result(str(file), json_file)
    write_json(json_file, scores.values)
