"""One training of a plan, gone on with where it stood, or a run that is there already.

Runs are those of `derender train`. A run that the budget ends is saved first.
"""

import json
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from derender.baselines import image_size_of, load_baseline, train_baseline
from derender.cli.plan.jobs import Job, Note, Place, facts_of_file
from derender.cli.plan.settings import OURS, WITHOUT_LOOP, Plan
from derender.evaluation.memory import content_hash
from derender.training.process import TrainingInterrupted


class BudgetUsed(Exception):
    """The time given to a comparison is over."""


def training_key(plan: Plan, job: Job) -> str:
    """Changes with the settings of a run and with the pictures."""
    given = plan.methods[job.method].runs.get(job.where)
    if given is not None:
        return content_hash({"run": [given, *map(facts_of_file, _weights(Path(given)))]})
    learnt = plan.train[job.where]
    config = plan.configuration(job.method, job.where, job.seed).model_dump(mode="json")
    data = [facts_of_file(learnt.data), learnt.dataset, learnt.limit]
    return content_hash({"config": config, "data": data})


def run_folder(plan: Plan, place: Place, job: Job) -> Path:
    """Where a training's run lies."""
    given = plan.methods[job.method].runs.get(job.where)
    return place.run(job.method, job.where, job.seed) if given is None else Path(given)


def train_job(
    plan: Plan, place: Place, job: Job, *, device: str, deadline: float | None, progress: Callable[..., None]
) -> Note:
    """Train, or go on with it, or take the run that is there; what it left is in the note."""
    key, run = training_key(plan, job), run_folder(plan, place, job)
    if job.where in plan.methods[job.method].runs:
        if job.seed:
            raise ValueError(f"{run} is one run: give seeds: 1, or let {job.method} be trained here")
        return Note(key, "done", facts={"run": str(run), **run_facts(plan.kind(job.method), run)})
    config = plan.configuration(job.method, job.where, job.seed)
    try:
        result = _train(plan, job, config, run, device, deadline, progress)
    except (TrainingInterrupted, BudgetUsed):
        if deadline is None or time.time() < deadline:
            raise
        done = run_progress(run)
        images = f" ({done['images']:,} of {plan.images:,} pictures seen)" if done["images"] else ""
        return Note(key, "stopped", f"the budget was used before it was trained{images}")
    if result.stopped == "collapse":
        signs = "; ".join(f"{finding.sign}: {finding.text}" for finding in result.findings)
        why = f"stopped by the watcher after {result.images:,} pictures ({signs})"
        return Note(key, "failed", why, final=True, facts={"run": str(run)})
    facts = {"run": str(run), **run_facts(plan.kind(job.method), run)}
    facts |= {"images": result.images, "seconds": result.seconds, "stopped": result.stopped}
    return Note(key, "done", facts=facts)


def _train(
    plan: Plan, job: Job, config: Any, run: Path, device: str, deadline: float | None, progress: Any
) -> Any:
    from derender.cli.models import chosen_device
    from derender.data import read_pictures
    from derender.report.run import baseline_sheet, decomposition_sheet
    from derender.training.derender_task import train

    learnt, in_the_loop = plan.train[job.where], plan.kind(job.method) not in WITHOUT_LOOP
    resume = in_the_loop and (run / "config.yaml").is_file()
    if run.exists() and not resume:  # killed at its very beginning, or nothing to go on with
        shutil.rmtree(run)
    pictures = read_pictures(
        learnt.data, image_size_of(config), dataset=learnt.dataset, limit=learnt.limit, progress=None
    )

    def watch(state: Any) -> None:
        progress(state.done, state.total, f"{state.images_per_second:.0f} pictures/s")
        if deadline is None or time.time() < deadline:
            return
        if state.phase == "train" and in_the_loop:
            signal.raise_signal(signal.SIGTERM)  # the loop saves and stops after this step
        else:
            raise BudgetUsed

    how = {"progress": watch, "accelerator": chosen_device(device)}
    if plan.kind(job.method) == OURS:
        return train(config, pictures, run, resume=resume, sample_sheet=decomposition_sheet, **how)
    return train_baseline(config, pictures, run, resume=resume, sample_sheet=baseline_sheet, **how)


def run_facts(kind: str, run: Path) -> dict[str, Any]:
    """Parameters, and for a finished run pictures seen and seconds as its last checkpoint has them."""
    from derender.model import load

    model: Any = load(str(run)) if kind == OURS else load_baseline(run, kind)
    return {"parameters": sum(values.numel() for values in model.parameters()), **run_progress(run)}


def run_progress(run: Path) -> dict[str, Any]:
    """Pictures seen and seconds of training by the last checkpoint; None where there is none."""
    try:
        state = json.loads((run / "checkpoints" / "last" / "state.json").read_text())["state"]
        return {"images": state["images"], "seconds": state["seconds"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {"images": None, "seconds": None}


def _weights(run: Path) -> list[str]:
    return [str(folder / "model.safetensors") for folder in (run / "model", run)]
