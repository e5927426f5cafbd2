"""The files of a comparison: for each protocol one table (Markdown, LaTeX, HTML, JSON) and one chart.

Made anew from the notes of all jobs every time, so they always show the present results.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.evaluation.score_table import Scores
from derender.learn.jobs import Comparison, Job, Note
from derender.learn.plan import OURS, Plan
from derender.report.compared import COST_COLUMNS, protocol_picture, protocol_table, scores_from, set_tables
from derender.report.comparison import comparison_page
from derender.report.page import write_whole
from derender.settings import plain

NAMES = {"cluster": "clustering", "linear": "linear"}
MISSING = {"failed": "failed", "stopped": "missing"}
Notes = Mapping[Job, Note]


def write_outcome(at: Comparison, notes: Notes) -> Scores:
    """Write every protocol's files beside the plan; gives the one table of each, and what ``--json`` says.

    Raises:
        ValueError: nothing at all could be scored.
    """
    plan, methods, summaries, files = at.plan, at.plan.rows(), [], []
    reasons: dict[str, list[str]] = {"failed": [], "missing": []}
    for job, note in notes.items():
        again = job.kind == "embed" and any(notes[one].state == note.state for one in job.after)
        if note.state in MISSING and not again:  # features whose training ended so are not named again
            reasons[MISSING[note.state]].append(f"{job.name}: {note.why}")
    absent = [*reasons["failed"], *reasons["missing"]]
    lead = f"Every method that is trained here saw {plan.images:,} images of the same training part."
    if plan.seeds == 1:
        lead += " One training seed each: intervals speak of which images were scored, not of trainings."
    if reasons["missing"]:
        lead += " The budget was used before everything was done: rows are missing."
    facts = {
        "methods": ", ".join(methods),
        "ours": ", ".join(name for name in methods if plan.kind(name) == OURS) or "none",
        "trained on": ", ".join(f"{name} ({one.data})" for name, one in plan.train.items()) or "nothing",
        "images seen": f"{plan.images:,}",
        "seeds": plan.seeds,
        "settings of all trainings": ", ".join(f"{k}={v}" for k, v in plan.settings.items()) or "none",
    }
    for protocol, name in NAMES.items():
        questions = [
            {**question, **_costs_and_absent(plan, job, notes)}
            for job, note in notes.items()
            if job.kind == "score" and note.state == "done"
            for question in note.facts["questions"]
            if question["protocol"] == protocol
        ]
        if not questions:
            continue
        scores = [score for one in questions for score in scores_from(one, one["costs"], one["absent"])]
        own = [table for one in scores for table in set_tables(one, methods)]
        tables, (svg, png) = [protocol_table(scores, methods), *own], protocol_picture(scores, methods)
        page = comparison_page(
            f"{name.capitalize()}: {', '.join(one['name'] for one in questions)}", tables,
            lead=lead, facts=facts, failed=absent, picture=svg,
        )  # fmt: skip
        text, listed = Scores(tables, {}), "".join(f"\n- {sentence}" for sentence in absent)
        contents = {
            ".md": text.to_markdown() + (f"\nFailed or missing:\n{listed}\n" if absent else ""),
            ".tex": text.to_latex(),
            ".html": page.html(),
            ".svg": _standalone(svg),
            ".png": png,
            ".json": json.dumps(
                plain({
                    "protocol": protocol, "questions": questions, **reasons,
                    "plan": plan.model_dump(mode="json"),
                }),
                indent=1, ensure_ascii=False,
            ) + "\n",
        }  # fmt: skip
        for suffix, content in contents.items():
            content = content if isinstance(content, bytes) else content.encode(errors="replace")
            files.append(write_whole(at.path / f"{name}{suffix}", content))
        summaries.append(tables[0])
    if not summaries:
        raise ValueError(f"nothing could be scored: {'; '.join(absent)}")
    shown = [table.values() for table in summaries]
    return Scores(summaries, {"out": at.path, "files": files, **reasons, "tables": shown})


def _standalone(svg: str) -> str:
    """A page's chart as a file of its own: on white, dark ink, with the name space that files need."""
    head, rest = svg.split(">", 1)
    space = "" if "xmlns=" in head else ' xmlns="http://www.w3.org/2000/svg"'
    ground = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'{head}{space} color="#1e293b" font-family="sans-serif">{ground}{rest}'


def _costs_and_absent(plan: Plan, job: Job, notes: Notes) -> dict[str, Any]:
    """By row, the cost (of controls by the scores' job); by method without a row, why, in a few words."""
    facts, absent = notes[job].facts, {}
    costs = {name: {**dict.fromkeys(COST_COLUMNS), "numbers": n} for name, n in facts["numbers"].items()}
    costs["untrained encoder"]["parameters"] = facts["untrained"]
    for method in plan.rows():
        mine = [one for one in job.after if one.method == method]
        done = [one for one in mine if notes[one].state == "done"]
        if not done:
            absent[method] = f"{MISSING[notes[mine[0]].state]}: {notes[mine[0]].why}"
        if not done or method not in costs:
            continue
        tables = [notes[one].facts for one in done]
        runs = [notes[one.after[0]].facts for one in done if one.after]
        seconds = [run["seconds"] for run in runs if run.get("seconds") is not None]
        costs[method] |= {
            "parameters": tables[0]["parameters"],
            "seconds": float(np.mean(seconds)) if seconds else None,
            "images": next((run["images"] for run in runs if run.get("images")), None),
            "embedding_seconds": float(np.mean([one["seconds_a_picture"] for one in tables])),
        }
    return {"costs": costs, "absent": absent}
