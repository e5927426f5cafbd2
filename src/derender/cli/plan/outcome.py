"""What a comparison leaves: for each protocol one table (Markdown, LaTeX, HTML, JSON) and one picture.

Made anew from the notes of all jobs every time, so they always show what is there.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from derender.cli.console import write_json
from derender.cli.plan.jobs import Job, Note, Place
from derender.cli.plan.settings import OURS, Plan

if TYPE_CHECKING:
    from derender.evaluation.score_table import ScoreTable
    from derender.report.compared import Cost, ScoredQuestion

NAMES = {"cluster": "clustering", "linear": "linear"}
MISSING = {"failed": "failed", "stopped": "missing"}


@dataclass(frozen=True)
class Outcome:
    """What there is to tell.

    Attributes:
        tables: the one table of each protocol.
        files: everything that was written.
        failed: sentences on what went wrong.
        missing: sentences on what the budget left undone.
    """

    tables: "list[ScoreTable]"
    files: list[Path]
    failed: list[str]
    missing: list[str]


def write_outcome(plan: Plan, place: Place, notes: Mapping[Job, Note]) -> Outcome:
    """Write every protocol's files beside the plan.

    Raises:
        ValueError: nothing at all could be scored.
    """
    from derender.evaluation.score_table import Scores
    from derender.report.compared import protocol_picture, protocol_table, scores_from, set_tables
    from derender.report.comparison import comparison_page
    from derender.report.page import write_whole

    found: dict[str, list[ScoredQuestion]] = {}
    kept: dict[str, list[Any]] = {}
    for job, note in notes.items():
        if job.kind == "score" and note.state == "done":
            costs = {**_costs(plan, job, notes), **_control_costs(note)}
            absent = _absent(plan, job, notes)
            for question in note.facts["questions"]:
                protocol = question["protocol"]
                found.setdefault(protocol, []).extend(scores_from(question, costs, absent))
                kept.setdefault(protocol, []).append({**question, "costs": costs, "absent": absent})
    failed, missing = _sentences(notes, "failed"), _sentences(notes, "stopped")
    if not found:
        raise ValueError(f"nothing could be scored: {'; '.join([*failed, *missing])}")
    tables, files = [], []
    for protocol, scores in found.items():
        methods = plan.rows()
        summary = protocol_table(scores, methods)
        every = [summary, *(table for one in scores for table in set_tables(one, methods))]
        shown = Scores(every, {})
        svg, png = protocol_picture(scores, methods)
        page = comparison_page(
            f"{NAMES[protocol].capitalize()}: {', '.join(one['name'] for one in kept[protocol])}",
            every,
            lead=_lead(plan, missing),
            facts=_facts(plan),
            failed=[*failed, *missing],
            picture=svg,
        )
        target = place.path / NAMES[protocol]
        told = "".join(f"\n- {sentence}" for sentence in (*failed, *missing))
        notes_text = f"\nFailed or missing:\n{told}\n" if told else ""
        for suffix, text in (
            (".md", shown.to_markdown() + notes_text),
            (".tex", shown.to_latex()),
            (".html", page.html()),
            (".svg", standing_alone(svg)),
        ):
            files.append(write_whole(target.with_suffix(suffix), text.encode()))
        files.append(write_whole(target.with_suffix(".png"), png))
        values = {"protocol": protocol, "questions": kept[protocol], "failed": failed, "missing": missing}
        write_json(str(target.with_suffix(".json")), {**values, "plan": plan.model_dump(mode="json")})
        files.append(target.with_suffix(".json"))
        tables.append(summary)
    return Outcome(tables, files, failed, missing)


def standing_alone(svg: str) -> str:
    """A page's chart as a file of its own: on white, dark ink, with the name space that files need."""
    head, rest = svg.split(">", 1)
    if "xmlns=" not in head:
        head += ' xmlns="http://www.w3.org/2000/svg"'
    ground = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'{head} color="#1e293b" font-family="sans-serif">{ground}{rest}'


def _costs(plan: Plan, job: Job, notes: Mapping[Job, Note]) -> "dict[str, Cost]":
    from derender.report.compared import Cost

    costs = {}
    for method in plan.rows():
        mine = [one for one in job.after if one.method == method]
        done = [notes[one].facts for one in mine if notes[one].state == "done"]
        runs = [notes[one.after[0]].facts for one in mine if one.after]
        if not done:
            continue
        seconds = [run["seconds"] for run in runs if run.get("seconds") is not None]
        embedding = [facts["seconds_a_picture"] for facts in done]
        costs[method] = Cost(
            done[0]["parameters"] or None,
            float(np.mean(seconds)) if seconds else None,
            next((run["images"] for run in runs if run.get("images")), None),
            done[0]["numbers"],
            float(np.mean(embedding)),
        )
    return costs


def _control_costs(note: Note) -> "dict[str, Cost]":
    from derender.report.compared import Cost

    return {
        name: Cost(parameters=facts["parameters"], numbers=facts["numbers"])
        for name, facts in note.facts["controls"].items()
    }


def _absent(plan: Plan, job: Job, notes: Mapping[Job, Note]) -> dict[str, str]:
    """Why a method has no row, in a few words that begin with failed or missing."""
    absent = {}
    for method in plan.rows():
        mine = [notes[one] for one in job.after if one.method == method]
        if not any(note.state == "done" for note in mine):
            absent[method] = f"{MISSING[mine[0].state]}: {mine[0].why}"
    return absent


def _sentences(notes: Mapping[Job, Note], state: str) -> list[str]:
    """What ended so, each reason once, with the first job that had it."""
    told: dict[tuple[str, str], str] = {}
    for job, note in notes.items():
        if note.state == state:
            trained = job.after[0].where if job.kind == "embed" and job.after else job.where
            told.setdefault((f"{job.method} {trained}", note.why), f"{job.name}: {note.why}")
    return list(told.values())


def _lead(plan: Plan, missing: list[str]) -> str:
    text = f"Every method that is trained here saw {plan.images:,} pictures of the same training part."
    if plan.seeds == 1:
        text += " One training seed each: intervals speak of which pictures were scored, not of trainings."
    if missing:
        text += " The budget was used before everything was done: rows are missing."
    return text


def _facts(plan: Plan) -> dict[str, object]:
    trained = ", ".join(f"{name} ({pictures.data})" for name, pictures in plan.train.items())
    ours = [name for name in plan.rows() if plan.kind(name) == OURS]
    return {
        "methods": ", ".join(plan.rows()),
        "ours": ", ".join(ours) or "none",
        "trained on": trained or "nothing",
        "pictures seen": f"{plan.images:,}",
        "seeds": plan.seeds,
        "settings of all trainings": ", ".join(f"{k}={v}" for k, v in plan.settings.items()) or "none",
    }
