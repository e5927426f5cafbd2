"""The files of a comparison: for each protocol one table (Markdown, LaTeX, HTML, JSON) and one chart.

Made anew from the notes of all jobs every time, so they always show the present results.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from derender.cli.console import write_json
from derender.cli.plan.settings import OURS, Plan
from derender.cli.plan.sweep import Job, Note, Sweep
from derender.evaluation.score_table import Scores, ScoreTable
from derender.report.compared import (
    Cost,
    ScoredQuestion,
    protocol_picture,
    protocol_table,
    scores_from,
    set_tables,
)
from derender.report.comparison import comparison_page
from derender.report.page import write_whole

NAMES = {"cluster": "clustering", "linear": "linear"}
MISSING = {"failed": "failed", "stopped": "missing"}


@dataclass(frozen=True)
class Outcome:
    """The results of a comparison.

    Attributes:
        tables: the one table of each protocol.
        files: everything that was written.
        failed: sentences on failures.
        missing: sentences on jobs that the budget left undone.
    """

    tables: list[ScoreTable]
    files: list[Path]
    failed: list[str]
    missing: list[str]


def write_outcome(sweep: Sweep) -> Outcome:
    """Write every protocol's files beside the plan.

    Raises:
        ValueError: nothing at all could be scored.
    """
    plan, notes = sweep.plan, sweep.notes
    questions: dict[str, list[ScoredQuestion]] = {}
    values: dict[str, list[Any]] = {}
    for job, note in notes.items():
        if job.kind == "score" and note.state == "done":
            costs, absent = _costs(plan, job, notes), _absent(plan, job, notes)
            for question in note.facts["questions"]:
                protocol = question["protocol"]
                questions.setdefault(protocol, []).extend(scores_from(question, costs, absent))
                values.setdefault(protocol, []).append({**question, "costs": costs, "absent": absent})
    failed, missing = _sentences(notes, "failed"), _sentences(notes, "stopped")
    if not questions:
        raise ValueError(f"nothing could be scored: {'; '.join([*failed, *missing])}")
    outcome = Outcome([], [], failed, missing)
    for protocol, scores in questions.items():
        methods = plan.rows()
        summary = protocol_table(scores, methods)
        tables = [summary, *(table for one in scores for table in set_tables(one, methods))]
        svg, png = protocol_picture(scores, methods)
        page = comparison_page(
            f"{NAMES[protocol].capitalize()}: {', '.join(one['name'] for one in values[protocol])}",
            tables,
            lead=_lead(plan, missing),
            facts=_facts(plan),
            failed=[*failed, *missing],
            picture=svg,
        )
        target, text = sweep.path / NAMES[protocol], Scores(tables, {})
        notes_text = "".join(f"\n- {sentence}" for sentence in (*failed, *missing))
        notes_text = f"\nFailed or missing:\n{notes_text}\n" if notes_text else ""
        contents = {
            ".md": (text.to_markdown() + notes_text).encode(),
            ".tex": text.to_latex().encode(),
            ".html": page.html().encode(),
            ".svg": _standalone(svg).encode(),
            ".png": png,
        }
        files = [write_whole(target.with_suffix(suffix), content) for suffix, content in contents.items()]
        numbers = {"protocol": protocol, "questions": values[protocol], "failed": failed, "missing": missing}
        write_json(str(target.with_suffix(".json")), {**numbers, "plan": plan.model_dump(mode="json")})
        outcome.files.extend([*files, target.with_suffix(".json")])
        outcome.tables.append(summary)
    return outcome


def _standalone(svg: str) -> str:
    """A page's chart as a file of its own: on white, dark ink, with the name space that files need."""
    head, rest = svg.split(">", 1)
    if "xmlns=" not in head:
        head += ' xmlns="http://www.w3.org/2000/svg"'
    ground = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'{head} color="#1e293b" font-family="sans-serif">{ground}{rest}'


def _costs(plan: Plan, job: Job, notes: Mapping[Job, Note]) -> dict[str, Cost]:
    """The cost of every row: of methods by their own jobs, of controls by the scores' job."""
    costs = {}
    for method in plan.rows():
        mine = [one for one in job.after if one.method == method]
        done = [notes[one].facts for one in mine if notes[one].state == "done"]
        runs = [notes[one.after[0]].facts for one in mine if one.after]
        if not done:
            continue
        seconds = [run["seconds"] for run in runs if run.get("seconds") is not None]
        costs[method] = Cost(
            done[0]["parameters"] or None,
            float(np.mean(seconds)) if seconds else None,
            next((run["images"] for run in runs if run.get("images")), None),
            done[0]["numbers"],
            float(np.mean([facts["seconds_a_picture"] for facts in done])),
        )
    controls = notes[job].facts["controls"].items()
    return costs | {
        name: Cost(parameters=facts["parameters"], numbers=facts["numbers"]) for name, facts in controls
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
    """The jobs that ended so, each reason once, with the first job that had it."""
    sentences: dict[tuple[str, str], str] = {}
    for job, note in notes.items():
        if note.state == state:
            trained = job.after[0].where if job.kind == "embed" and job.after else job.where
            sentences.setdefault((f"{job.method} {trained}", note.why), f"{job.name}: {note.why}")
    return list(sentences.values())


def _lead(plan: Plan, missing: list[str]) -> str:
    text = f"Every method that is trained here saw {plan.images:,} images of the same training part."
    if plan.seeds == 1:
        text += " One training seed each: intervals speak of which images were scored, not of trainings."
    return f"{text} The budget was used before everything was done: rows are missing." if missing else text


def _facts(plan: Plan) -> dict[str, object]:
    trained = ", ".join(f"{name} ({images.data})" for name, images in plan.train.items())
    ours = [name for name in plan.rows() if plan.kind(name) == OURS]
    return {
        "methods": ", ".join(plan.rows()),
        "ours": ", ".join(ours) or "none",
        "trained on": trained or "nothing",
        "images seen": f"{plan.images:,}",
        "seeds": plan.seeds,
        "settings of all trainings": ", ".join(f"{k}={v}" for k, v in plan.settings.items()) or "none",
    }
