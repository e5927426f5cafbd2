"""The three kinds of a plan's jobs, each one or two library calls; they return the facts of their notes."""

import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from derender import learn
from derender.baselines import control_features, load_baseline, open_baseline, read_any_config
from derender.baselines.registry import CONTROLS
from derender.cli.console import plain
from derender.cli.plan.settings import OURS, WITHOUT_LOOP
from derender.cli.plan.sweep import COMPONENTS, BudgetUsed, Collapsed, Job, Sweep, run_progress
from derender.data import ImageSet, split_indices
from derender.evaluation.clustering import compare_clusterings
from derender.evaluation.controls import control_rows
from derender.evaluation.feature_rows import FeatureRow, aligned, attribute_columns, prepare
from derender.evaluation.linear_probing import compare_prepared
from derender.evaluation.memory import Memory
from derender.evaluation.paper_tables import ATTRIBUTES, RowRules, table_named
from derender.features import FeatureTable, embed_pictures
from derender.inputs import as_images, as_model, device_named
from derender.model import Derenderer
from derender.presets import MODEL_PRESETS
from derender.training import TrainingInterrupted

Progress = Callable[..., None]


def train(sweep: Sweep, job: Job, progress: Progress) -> dict[str, Any]:
    """Train, or go on with it, or take the run that is there."""
    plan, run = sweep.plan, sweep.run(job)
    kind, in_the_loop = plan.kind(job.method), plan.kind(job.method) not in WITHOUT_LOOP
    if job.where in plan.methods[job.method].runs:
        if job.seed:
            raise ValueError(f"{run} is one run: give seeds: 1, or let {job.method} be trained here")
        return _run_facts(kind, run)
    resume = in_the_loop and (run / "config.yaml").is_file()
    if run.exists() and not resume:  # killed at its very beginning, or nothing to go on with
        shutil.rmtree(run)
    learnt = plan.train[job.where]

    def watch(at: Any) -> None:
        progress(at.done, at.total, f"{at.images_per_second:.0f} pictures/s")
        if sweep.over:
            if at.phase != "train" or not in_the_loop:
                raise BudgetUsed
            signal.raise_signal(signal.SIGTERM)  # the loop saves and stops after this step

    try:
        result = learn.train(
            learnt.data, out=run, config=plan.configuration(job.method, job.where, job.seed), resume=resume,
            dataset=learnt.dataset, limit=learnt.limit, device=sweep.device, page=False, progress=watch,
        )  # fmt: skip
    except (TrainingInterrupted, BudgetUsed) as stop:
        if not sweep.over:
            raise
        images = run_progress(run)["images"]
        seen = f" ({images:,} of {plan.images:,} images seen)" if images else ""
        raise BudgetUsed(f"the budget was used before it was trained{seen}") from stop
    if result.stopped == "collapse":
        signs = "; ".join(f"{finding.sign}: {finding.text}" for finding in result.findings)
        raise Collapsed(f"stopped by the watcher after {result.images:,} images ({signs})")
    facts = {"images": result.images, "seconds": result.seconds, "stopped": result.stopped}
    return {**_run_facts(kind, run), **facts}


def embed(sweep: Sweep, job: Job, progress: Progress) -> dict[str, Any]:
    """Write the feature table of a scored set by one method."""
    plan, kind = sweep.plan, sweep.plan.kind(job.method)
    method, parameters = plan.methods[job.method], 0

    def watch(done: int, total: int) -> None:
        progress(done, total)
        if sweep.over and done < total:
            raise BudgetUsed("the budget was used before its features were made")

    if kind in CONTROLS:
        images = _scored_images(sweep, job.where, plan.image_size)
        began = time.perf_counter()
        table = control_features(kind, images, components=COMPONENTS, seed=job.seed, progress=watch)
    else:
        source = plan.methods[plan.source(job.method)].model
        source = str(sweep.run(job.after[0])) if job.after else source
        net = _opened(sweep, job.method, source)
        images = _scored_images(sweep, job.where, net.image_size, source if job.after else None)
        parameters = sum(values.numel() for values in net.parameters())
        began = time.perf_counter()
        table = embed_pictures(net, images, progress=watch)
    seconds = time.perf_counter() - began
    table.write(sweep.features(job))
    factors = method.features or (("geometry", "albedo") if kind == OURS else tuple(table.factors))
    return {
        "rows": len(table),
        "factors": list(factors),
        "numbers": int(table.concatenate(factors).shape[1]),
        "parameters": parameters,
        "seconds_a_picture": seconds / len(table),
    }


def score(sweep: Sweep, job: Job, progress: Progress) -> dict[str, Any]:
    """Score the finished methods on one set, beside controls; the others' notes say why they are missing."""
    plan, scored, memory = sweep.plan, sweep.plan.score[job.where], Memory(sweep.path / "memory")
    rows = []
    for method in plan.rows():
        notes = {one: sweep.note(one) for one in job.after if one.method == method}
        done = {one: note for one, note in notes.items() if note is not None and note.state == "done"}
        if done:
            tables = tuple(FeatureTable.read(sweep.features(one)) for one in done)
            factors = tuple(next(iter(done.values())).facts["factors"])
            rows.append(FeatureRow(method, tables, factors, "control" in tables[0].origin))
    images = _scored_images(sweep, job.where, plan.image_size)
    if rows:
        images = aligned(images, rows[0].tables[0].files)
    settings, factors = _architecture(sweep, job.where), ("geometry", "albedo")
    seeds = range(plan.untrained_seeds)
    controls = control_rows(images, settings, factors, seeds, memory=memory, device=sweep.device)
    parameters = sum(values.numel() for values in Derenderer.seeded(settings, 0).parameters())
    facts = {
        row.name: {
            "numbers": int(row.tables[0].concatenate(row.factors).shape[1]),
            "parameters": parameters if row.name.startswith("untrained") else None,
        }
        for row in controls
    }
    rows += controls
    found = []
    for name, columns, rules in _questions(sweep, job.where, rows[0].tables[0]):
        ready = prepare(rows, columns, **asdict(rules))
        for protocol in scored.protocols:
            how: dict[str, Any] = {"resample_count": plan.resamples, "memory": memory}
            if protocol == "cluster":
                groups = {"controls": ready.controls, "method": plan.clustering, **how}
                numbers = compare_clusterings(ready.features, ready.labels, **groups).numbers()
                numbers.pop("per_label")
            else:
                numbers = compare_prepared(ready, plan.counts, tuple(range(plan.draws)), **how).numbers()
            found.append(plain({"name": name, "protocol": protocol, **numbers}))
    return {"questions": found, "controls": facts}


def _run_facts(kind: str, run: Path) -> dict[str, Any]:
    """Parameters, and images seen and seconds by the last checkpoint."""
    model: Any = as_model(run, device="cpu") if kind == OURS else load_baseline(run, kind)
    parameters = sum(values.numel() for values in model.parameters())
    return {"run": str(run), "parameters": parameters, **run_progress(run)}


def _opened(sweep: Sweep, name: str, source: str | None) -> Any:
    """The network of a method, ready to embed."""
    method, kind = sweep.plan.methods[name], sweep.plan.kind(name)
    if kind != OURS:
        device = device_named(sweep.device)
        return open_baseline(
            kind, source, device=device, features=method.features or None, image_size=sweep.plan.image_size
        )
    if source is None:
        raise ValueError(f"method {name!r} has neither runs nor a model")
    model = as_model(source, device=sweep.device)
    return model if method.whitened else model.without_features()


def _scored_images(sweep: Sweep, where: str, image_size: int, run: str | None = None) -> ImageSet:
    """The images to score: all, or a part of the training set's split, which ``run`` must have kept."""
    scored = sweep.plan.score[where]
    images = as_images(scored.data, image_size, dataset=scored.dataset, limit=scored.limit)
    if scored.part == "all":
        return images
    learnt = sweep.plan.train[str(scored.trained_on)]
    if run is not None and (Path(run) / "config.yaml").is_file():
        config = read_any_config(Path(run))
        if (tuple(config.split), config.seed) != (tuple(learnt.split), 0):
            raise ValueError(
                f"{run} was trained with split {list(config.split)} and seed {config.seed}, the plan's is "
                f"{list(learnt.split)} and 0: part {scored.part} would hold images that it saw"
            )
    split = split_indices(images.files, learnt.split, seed=0)
    return images.select(getattr(split, scored.part)).require(2, f"the {scored.part} part")


def _architecture(sweep: Sweep, where: str) -> Any:
    """Settings of the untrained encoder: the first trained derender method's, or those of preset small."""
    plan, trained_on = sweep.plan, sweep.plan.score[where].trained_on
    own = [name for name in plan.rows() if plan.kind(name) == OURS and plan.is_trained(name)]
    if own and trained_on is not None:
        settings = plan.configuration(plan.source(own[0]), trained_on, 0).model
        if settings.network.image_size == plan.image_size:
            return settings
    small = MODEL_PRESETS["small"]
    network = small.network.model_copy(update={"image_size": plan.image_size})
    return small.model_copy(update={"network": network})


def _questions(sweep: Sweep, where: str, table: FeatureTable) -> list[tuple[str, tuple[str, ...], RowRules]]:
    """Names, label columns and row rules of a scored set's questions, by the labels it has."""
    scored = sweep.plan.score[where]
    have = ", ".join(table.labels) or "none"
    if scored.table is None:
        columns = attribute_columns(table) if scored.label == (ATTRIBUTES,) else scored.label
        if not columns:
            raise ValueError(f"{scored.data} has no yes/no label; it has {have}")
        for column in (*columns, *scored.mean_by):
            table.label(column)
        return [(where, tuple(columns), RowRules(scored.mean_by, scored.min_count, scored.max_count))]
    parts = [part for part in table_named(scored.table).parts if part.columns(table)]
    if not parts:
        raise ValueError(f"table {scored.table!r} needs other labels than {scored.data} has ({have})")
    names = [f"{where} {part.name}" if len(parts) > 1 else where for part in parts]
    return [(name, part.columns(table), part.rows(table)) for name, part in zip(names, parts, strict=True)]
