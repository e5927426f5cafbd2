"""One feature table of a plan: the pictures of a scored set through one trained method."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derender.baselines import control_features, open_baseline, read_any_config
from derender.baselines.registry import CONTROLS
from derender.cli.plan.jobs import Job, Note, Place, facts_of_file
from derender.cli.plan.settings import OURS, Plan, ScoredSet
from derender.cli.plan.training import BudgetUsed, run_folder
from derender.evaluation.memory import content_hash

if TYPE_CHECKING:
    from derender.data import PictureSet


def embedding_key(plan: Plan, job: Job, trained: Note | None) -> str:
    """Changes with the run, the pictures and the choice of features."""
    method, scored = plan.methods[job.method], plan.score[job.where]
    return content_hash(
        {
            "kind": plan.kind(job.method),
            "run": None if trained is None else trained.key,
            "model": plan.methods[plan.source(job.method)].model,
            "features": [list(method.features), method.whitened, plan.image_size],
            "data": [facts_of_file(scored.data), scored.dataset, scored.limit, scored.part],
            "split": None if scored.part == "all" else list(plan.train[str(scored.trained_on)].split),
        }
    )


def embed_job(
    plan: Plan, place: Place, job: Job, *, device: str, deadline: float | None, progress: Callable[..., None]
) -> Note:
    """Write the table; the note says how long a picture took and how many numbers describe it."""
    from derender.features import embed_pictures

    method, kind, scored = plan.methods[job.method], plan.kind(job.method), plan.score[job.where]
    trained = place.note(job.after[0]) if job.after else None
    key = embedding_key(plan, job, trained)
    if trained is not None and trained.state != "done":
        return Note(key, trained.state, trained.why, final=trained.final)

    def watch(done: int, total: int) -> None:
        progress(done, total)
        if deadline is not None and time.time() > deadline and done < total:
            raise BudgetUsed

    try:
        if kind in CONTROLS:
            pictures = scored_pictures(scored, plan, plan.image_size)
            began = time.perf_counter()
            table = control_features(kind, pictures, seed=job.seed, progress=watch)
            parameters = 0
        else:
            source = str(run_folder(plan, place, job.after[0])) if job.after else None
            source = source or plan.methods[plan.source(job.method)].model
            net = opened(plan, job.method, source, device)
            pictures = scored_pictures(scored, plan, net.image_size, source if job.after else None)
            parameters = sum(values.numel() for values in net.parameters())
            began = time.perf_counter()
            table = embed_pictures(net, pictures, progress=watch)
    except BudgetUsed:
        return Note(key, "stopped", "the budget was used before its features were made")
    seconds = time.perf_counter() - began
    table.write(place.features(job))
    factors = method.features or (("geometry", "albedo") if kind == OURS else tuple(table.factors))
    facts = {
        "rows": len(table),
        "factors": list(factors),
        "numbers": int(table.concatenate(factors).shape[1]),
        "parameters": parameters,
        "seconds_a_picture": seconds / len(table),
    }
    return Note(key, "done", facts=facts)


def opened(plan: Plan, name: str, source: str | None, device: str) -> Any:
    """The network of a method, ready to embed."""
    from derender.cli.models import chosen_device, open_model

    method, kind = plan.methods[name], plan.kind(name)
    if kind == OURS:
        if source is None:
            raise ValueError(f"method {name!r} has neither runs nor a model")
        net = open_model(source, device)
        return net if method.whitened else net.without_features()
    return open_baseline(
        kind,
        source,
        device=chosen_device(device),
        features=method.features or None,
        image_size=plan.image_size,
    )


def scored_pictures(scored: ScoredSet, plan: Plan, image_size: int, run: str | None = None) -> "PictureSet":
    """The pictures to score: all, or a part of the training set's split, which ``run`` must have kept."""
    from derender.data import read_pictures, split_indices

    pictures = read_pictures(scored.data, image_size, dataset=scored.dataset, limit=scored.limit)
    if scored.part == "all":
        return pictures
    learnt = plan.train[str(scored.trained_on)]
    if run is not None and (Path(run) / "config.yaml").is_file():
        config = read_any_config(Path(run))
        if (tuple(config.split), config.seed) != (tuple(learnt.split), 0):
            raise ValueError(
                f"{run} was trained with split {list(config.split)} and seed {config.seed}, the plan's is "
                f"{list(learnt.split)} and 0: part {scored.part} would not be what it did not see"
            )
    split = split_indices(pictures.files, learnt.split, seed=0)
    return pictures.select(getattr(split, scored.part)).require(2, f"the {scored.part} part")
