"""The files of a comparison: for each protocol one table (Markdown, LaTeX, HTML, JSON) and one chart.

Made anew from the notes of all jobs every time, so they always show the present results.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.cli.console import write_json
from derender.cli.plan.jobs import Comparison, Job, Note
from derender.cli.plan.settings import OURS, Plan
from derender.evaluation.score_table import Scores, ScoreTable
from derender.report.compared import COST_COLUMNS, protocol_picture, protocol_table, scores_from, set_tables
from derender.report.comparison import comparison_page
from derender.report.page import write_whole

NAMES = {"cluster": "clustering", "linear": "linear"}
MISSING = {"failed": "failed", "stopped": "missing"}
Notes = Mapping[Job, Note]


def write_outcome(at: Comparison, notes: Notes) -> tuple[list[ScoreTable], dict[str, Any]]:
    """Write every protocol's files beside the plan; gives the one table of each, and what ``--json`` says.

    Raises:
        ValueError: nothing at all could be scored.
    """
    plan, methods = at.plan, at.plan.rows()
    summaries, files = [], []
    reasons = {word: _sentences(notes, state) for state, word in MISSING.items()}
    absent = [*reasons["failed"], *reasons["missing"]]
    for protocol, name in NAMES.items():
        questions = [
            {**question, "costs": _costs(plan, job, notes), "absent": _absent(plan, job, notes)}
            for job, note in notes.items()
            if job.kind == "score" and note.state == "done"
            for question in note.facts["questions"]
            if question["protocol"] == protocol
        ]
        if not questions:
            continue
        scores = [score for one in questions for score in scores_from(one, one["costs"], one["absent"])]
        tables = [
            protocol_table(scores, methods),
            *(table for one in scores for table in set_tables(one, methods)),
        ]
        svg, png = protocol_picture(scores, methods)
        page = comparison_page(
            f"{name.capitalize()}: {', '.join(one['name'] for one in questions)}", tables,
            lead=_lead(plan, bool(reasons["missing"])), facts=_facts(plan), failed=absent, picture=svg,
        )  # fmt: skip
        text, target = Scores(tables, {}), at.path / name
        listed = "".join(f"\n- {sentence}" for sentence in absent)
        contents = {
            ".md": text.to_markdown() + (f"\nFailed or missing:\n{listed}\n" if absent else ""),
            ".tex": text.to_latex(),
            ".html": page.html(),
            ".svg": _standalone(svg),
            ".png": png,
        }
        for suffix, content in contents.items():
            content = content if isinstance(content, bytes) else content.encode()
            files.append(write_whole(target.with_suffix(suffix), content))
        files.append(target.with_suffix(".json"))
        values = {"protocol": protocol, "questions": questions, **reasons}
        write_json(str(files[-1]), {**values, "plan": plan.model_dump(mode="json")})
        summaries.append(tables[0])
    if not summaries:
        raise ValueError(f"nothing could be scored: {'; '.join(absent)}")
    shown = [table.values() for table in summaries]
    return summaries, {"out": at.path, "files": files, **reasons, "tables": shown}


def _standalone(svg: str) -> str:
    """A page's chart as a file of its own: on white, dark ink, with the name space that files need."""
    head, rest = svg.split(">", 1)
    space = "" if "xmlns=" in head else ' xmlns="http://www.w3.org/2000/svg"'
    ground = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'{head}{space} color="#1e293b" font-family="sans-serif">{ground}{rest}'


def _costs(plan: Plan, job: Job, notes: Notes) -> dict[str, dict[str, Any]]:
    """The cost of every row: of methods by their own jobs, of controls by the scores' job."""
    facts = notes[job].facts
    costs = {
        name: {**dict.fromkeys(COST_COLUMNS), "numbers": size} for name, size in facts["numbers"].items()
    }
    costs["untrained encoder"]["parameters"] = facts["untrained"]
    for method in costs.keys() & set(plan.rows()):
        done = [one for one in job.after if one.method == method and notes[one].state == "done"]
        tables, runs = (
            [notes[one].facts for one in done],
            [notes[one.after[0]].facts for one in done if one.after],
        )
        seconds = [run["seconds"] for run in runs if run.get("seconds") is not None]
        costs[method] |= {
            "parameters": tables[0]["parameters"],
            "seconds": float(np.mean(seconds)) if seconds else None,
            "images": next((run["images"] for run in runs if run.get("images")), None),
            "embedding_seconds": float(np.mean([one["seconds_a_picture"] for one in tables])),
        }
    return costs


def _absent(plan: Plan, job: Job, notes: Notes) -> dict[str, str]:
    """Why a method has no row, in a few words that begin with failed or missing."""
    mine = {method: [notes[one] for one in job.after if one.method == method] for method in plan.rows()}
    return {
        method: f"{MISSING[own[0].state]}: {own[0].why}"
        for method, own in mine.items()
        if all(note.state != "done" for note in own)
    }


def _sentences(notes: Notes, state: str) -> list[str]:
    """The jobs that ended so; features whose training ended so are not named again."""
    return [
        f"{job.name}: {note.why}"
        for job, note in notes.items()
        if note.state == state
        and not (job.kind == "embed" and any(notes[one].state == state for one in job.after))
    ]


def _lead(plan: Plan, missing: bool) -> str:
    text = f"Every method that is trained here saw {plan.images:,} images of the same training part."
    if plan.seeds == 1:
        text += " One training seed each: intervals speak of which images were scored, not of trainings."
    return f"{text} The budget was used before everything was done: rows are missing." if missing else text


def _facts(plan: Plan) -> dict[str, object]:
    ours = [name for name in plan.rows() if plan.kind(name) == OURS]
    return {
        "methods": ", ".join(plan.rows()),
        "ours": ", ".join(ours) or "none",
        "trained on": ", ".join(f"{name} ({one.data})" for name, one in plan.train.items()) or "nothing",
        "images seen": f"{plan.images:,}",
        "seeds": plan.seeds,
        "settings of all trainings": ", ".join(f"{k}={v}" for k, v in plan.settings.items()) or "none",
    }
