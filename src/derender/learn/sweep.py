"""A comparison by plan: trainings, feature tables and scores as jobs that are each done once.

A job whose note (``jobs``) says that it is done is not repeated; a training continues from its last
checkpoint. With several workers each job has a process of its own, so that one that is killed costs itself
alone. Tables (Markdown, LaTeX, HTML, JSON) and charts are made anew from the notes of all jobs every time.
"""

import json
import multiprocessing
import os
import sys
import threading
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from math import inf
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout

from derender.evaluation.score_table import Scores
from derender.learn.jobs import Collapsed, Comparison, Job, Note, embed, jobs_of, no_bar, score, train
from derender.learn.plan import OURS, Plan, read_plan
from derender.report.comparison import (
    COST_COLUMNS,
    comparison_page,
    protocol_picture,
    protocol_table,
    scores_from,
    set_tables,
)
from derender.settings import plain
from derender.storage.atomic import write_whole
from derender.training import TrainingInterrupted
from derender.training.config import to_yaml

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
        record = {
            "protocol": protocol,
            "questions": questions,
            **reasons,
            "plan": plan.model_dump(mode="json"),
        }
        contents = {
            ".md": text.to_markdown() + (f"\nFailed or missing:\n{listed}\n" if absent else ""),
            ".tex": text.to_latex(),
            ".html": page.html(),
            ".svg": _standalone(svg),
            ".png": png,
            ".json": json.dumps(plain(record), indent=1, ensure_ascii=False) + "\n",
        }
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


def compare_plan(
    plan: Plan | str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    minutes: float | None = None,
    device: str = "auto",
    tell: Callable[[str], object] = lambda text: None,
    bar: Callable[..., Any] = no_bar,
) -> Scores:
    """Train, embed and score every method of a plan, or resume it, and write its tables and charts.

    Args:
        plan: as ``learn.plan`` reads it from a YAML or TOML file, or that file.
        out: the folder of runs, features, tables and charts.
        workers: jobs at a time.
        minutes: the budget: after it a training is saved and nothing but scoring is begun.
        device: "auto", "cpu" or "cuda".
        tell: called with a sentence when a job ends.
        bar: makes the progress bar of a job, ``bar(text, unit=...)``; it must be picklable.

    Returns:
        The one table of each protocol; ``values`` has files, tables, and what failed or is missing.

    Raises:
        ValueError: the plan does not fit, the folder holds something else, another process works in it, or
            nothing could be scored.
    """
    plan, out = (plan if isinstance(plan, Plan) else read_plan(plan)), Path(out)
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file: give the name of a folder")
    others = out.is_dir() and any(one.name[0] != "." for one in out.iterdir())  # . files: of a kill
    if others and not (out / "plan.yaml").is_file():
        raise ValueError(f"{out} is not empty and holds no comparison: choose another folder")
    write_whole(out / "plan.yaml", to_yaml(plan))
    at = Comparison(plan, out, device, inf if minutes is None else time.time() + 60 * minutes, bar)
    jobs, notes = jobs_of(plan), {}
    lanes: dict[Job, list[Job]] = defaultdict(list)
    for job in jobs:
        lanes[job.after[0] if job.kind == "embed" and job.after else job].append(job)

    def do(lane: list[Job]) -> None:
        for job in lane:
            note, began = at.known(job), time.perf_counter()
            if note is None:
                note = perform(at, job) if workers == 1 else in_own_process(at, job)
                why = "" if note.state == "done" else f": {note.why}"
                took = f"{(time.perf_counter() - began) / 60:.1f} min"
                tell(f"[{len(notes) + 1}/{len(jobs)}] {job.name}: {note.state}{why} ({took})")
            notes[job] = note

    if workers > 1:
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, torch.get_num_threads() // workers)))
    try:
        with FileLock(out / ".lock", timeout=0), ThreadPoolExecutor(workers) as pool:
            for kind in ("embed", "train", "score"):  # features that need no training come first
                stage = [lane for lane in lanes.values() if lane[0].kind == kind]
                list((map if workers == 1 else pool.map)(do, stage))
    except Timeout as error:
        raise ValueError(
            f"another derender compare works in {out}: wait for it, or choose another folder"
        ) from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("stopped and saved; the same command continues where it stopped") from stop
    return write_outcome(at, {job: notes[job] for job in jobs})


def perform(at: Comparison, job: Job) -> Note:
    """Do one job and leave its note, whatever happens in it."""
    try:
        work = {"train": train, "embed": embed, "score": score}[job.kind]
        with at.bar(job.name, unit="steps" if job.kind == "score" else "images") as progress:
            return at.leave(job, facts=work(at, job, progress))
    except TrainingInterrupted:
        if not at.over:
            raise
        return at.stopped(job)
    except Exception as error:
        with at.file("logs", job, ".log").open("a") as stream:
            traceback.print_exc(file=stream)
        why, kind = " ".join(str(error).split()), type(error).__name__
        if not why or not isinstance(error, ValueError | OSError):
            why = f"{kind}: {why}".rstrip(": ")
        return at.leave(job, state="failed", why=why, final=isinstance(error, Collapsed))


def in_own_process(at: Comparison, job: Job) -> Note:
    """The same in a process of its own, whose words go to a file."""
    log, spawn = at.file("logs", job, ".log"), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn, initializer=_begin_worker, initargs=(log,)) as pool:
        try:
            return pool.submit(perform, at, job).result()
        except BrokenProcessPool:
            return at.leave(job, state="failed", why=f"its process was killed: see {log}")


def _begin_worker(log: Path) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    stream = log.open("a")
    os.dup2(stream.fileno(), sys.stdout.fileno())
    os.dup2(stream.fileno(), sys.stderr.fileno())


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
