"""The jobs of a plan, what each leaves in the comparison's folder, and the library calls that do them.

A job leaves a note beside its result: a key (the hash of its inputs), how it ended, its cost. A job whose
note has the same key is not repeated; a training continues from its last checkpoint.
"""

import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from derender.baselines import CONTROLS, control_features, load_baseline, open_baseline
from derender.data import ImageSet, split_indices
from derender.data.source import stamps_of
from derender.evaluation.clustering import compare_clusterings
from derender.evaluation.controls import architecture, control_rows
from derender.evaluation.feature_rows import FeatureRow, chosen_labels, prepare
from derender.evaluation.linear_probing import compare_prepared
from derender.evaluation.memory import content_hash
from derender.evaluation.options import Options, aligned
from derender.evaluation.paper_tables import ATTRIBUTES, TABLES
from derender.features import FeatureTable, embed_image_set
from derender.inputs import as_images, as_model, split_of
from derender.learn.plan import OURS, WITHOUT_LOOP, Plan
from derender.learn.runs import train as train_run
from derender.model import Derenderer
from derender.presets import MODEL_PRESETS
from derender.settings import Settings, plain
from derender.storage.atomic import write_whole
from derender.storage.bounded import read_json
from derender.storage.folder import SplitRecord
from derender.training import TrainingInterrupted
from derender.training.config import with_changes

COMPONENTS = 64  # of pca and noise
SCORING = {"clustering", "counts", "draws", "untrained_seeds", "resamples", "image_size"}
Facts = dict[str, Any]


class Collapsed(ValueError):
    """A training that would collapse again."""


@contextmanager
def no_bar(text: str, unit: str) -> Iterator[Callable[..., None]]:
    """No progress bar."""
    yield lambda *done, **more: None


@dataclass(frozen=True)
class Job:
    """One training, feature table or set of scores (of all methods) on a training set or a scored set.

    Jobs in ``after`` must have ended before, well or not.
    """

    kind: Literal["train", "embed", "score"]
    method: str
    where: str
    seed: int = 0
    after: tuple["Job", ...] = ()

    @property
    def name(self) -> str:
        """In words."""
        relation = {"train": "on", "embed": "of", "score": ""}[self.kind]
        run = f"seed {self.seed}" if self.seed else ""
        return " ".join(filter(None, (self.kind, self.method, run, relation, self.where)))

    @property
    def slug(self) -> str:
        """As a file's name; no two jobs of a plan share one."""
        words = "-".join((self.kind, self.where, self.method, str(self.seed)))
        return f"{re.sub('[^A-Za-z0-9]+', '-', words)}-{content_hash({'name': words})[:6]}"


class Note(Settings):
    """How a job ended: ``why`` it is not done, and whether that is ``final``; its results and its cost."""

    job: str
    key: str
    state: Literal["done", "failed", "stopped"] = "done"
    why: str = ""
    final: bool = False
    facts: Facts = Field(default_factory=dict)


def jobs_of(plan: Plan) -> list[Job]:
    """All of a plan's jobs, each after those it needs; trainings in the order of the plan's data sets."""
    jobs: dict[Job, None] = {}
    scores: list[Job] = []
    for name, scored in plan.score.items():
        tables = []
        for method in plan.rows():
            trained = plan.is_trained(method)
            for seed in range(plan.seeds if trained else 1):
                training = Job("train", plan.source(method), str(scored.trained_on), seed)
                tables.append(Job("embed", method, name, seed, (training,) if trained else ()))
                jobs |= dict.fromkeys((*tables[-1].after, tables[-1]))
        scores.append(Job("score", "", name, 0, tuple(tables)))
    return [*jobs, *scores]


@dataclass
class Comparison:
    """A plan in its folder; the budget ends at ``deadline``, in seconds since 1970."""

    plan: Plan
    path: Path
    device: str = "auto"
    deadline: float = inf
    bar: Callable[..., Any] = no_bar

    @property
    def over(self) -> bool:
        """Whether the budget is used."""
        return time.time() >= self.deadline

    def file(self, folder: str, job: Job, suffix: str) -> Path:
        """A job's file: its ``.json`` in jobs, ``.parquet`` in features, or ``.log`` in logs."""
        (self.path / folder).mkdir(parents=True, exist_ok=True)
        return self.path / folder / f"{job.slug}{suffix}"

    def result(self, job: Job) -> Path:
        """The run folder of a training, the table of features, or the note that holds the scores."""
        if job.kind != "train":
            return self.file("features", job, ".parquet") if job.method else self.file("jobs", job, ".json")
        name = job.method if job.seed == 0 else f"{job.method}-seed{job.seed}"
        given = self.plan.methods[job.method].runs.get(job.where)
        return self.path / "runs" / job.where / name if given is None else Path(given)

    def note(self, job: Job) -> Note | None:
        """The note that a job left; None without one that can be read."""
        try:
            return read_json(self.file("jobs", job, ".json"), Note)
        except (FileNotFoundError, ValueError):
            return None

    def leave(self, job: Job, **how: Any) -> Note:
        """Write a job's note."""
        note = Note(job=job.name, key=self.key(job), **how)
        write_whole(self.file("jobs", job, ".json"), note.model_dump_json(indent=1))
        return note

    def known(self, job: Job) -> Note | None:
        """The note of a job that need not be done, or can no longer be."""
        note = self.note(job)
        needed = self.note(job.after[0]) if job.kind == "embed" and job.after else None
        ended = note is not None and (note.final or (note.state == "done" and self.result(job).exists()))
        if note is not None and ended and note.key == self.key(job):
            return note
        if needed is not None and needed.state != "done":
            return self.leave(job, state=needed.state, why=needed.why, final=needed.final)
        return self.stopped(job) if self.over and job.kind != "score" else None

    def stopped(self, job: Job) -> Note:
        """Leave the note of a job that the end of the budget stopped, or kept from beginning."""
        images = run_progress(self.result(job))["images"] if job.kind == "train" else None
        seen = f" ({images:,} of {self.plan.images:,} images seen)" if images else ""
        return self.leave(job, state="stopped", why=f"the budget was used before it was done{seen}")

    def key(self, job: Job) -> str:
        """Changes with the settings and files of a job, and with the results of those before it."""
        plan, method, run = self.plan, self.plan.methods.get(job.method), self.result(job)
        source = plan.train[job.where] if job.kind == "train" else plan.score[job.where]
        read, files = {"data", "dataset", "limit", "part", "split"}, [Path(source.data.partition("::")[0])]
        if method is None:
            how, read = plan.model_dump(mode="json", include=SCORING), None
        elif job.kind == "embed":
            model = plan.methods[plan.source(job.method)].model
            how = [plan.kind(job.method), model, method.features, method.whitened, plan.image_size]
        elif job.where in method.runs:
            how = str(run)
            files += [run / "model" / "model.safetensors", run / "model.safetensors"]
        else:
            how = plan.configuration(job.method, job.where, job.seed).model_dump(mode="json")
        times = stamps_of(file for file in files if file.is_file()).tolist()
        before = [(note.key, note.state) for one in job.after if (note := self.note(one))]
        images = source.model_dump(mode="json", include=read)
        return content_hash({"images": images, "how": how, "files": times, "before": before})


def train(at: Comparison, job: Job, progress: Callable[..., None]) -> Facts:
    """Train, or resume, or take the run that is there."""
    plan, run, facts = at.plan, at.result(job), {}
    kind, in_the_loop = plan.kind(job.method), plan.kind(job.method) not in WITHOUT_LOOP
    if job.where not in plan.methods[job.method].runs:
        resume = in_the_loop and (run / "config.yaml").is_file()
        if run.exists() and not resume:  # killed at its very beginning, or nothing to go on with
            shutil.rmtree(run)

        def watch(now: Any) -> None:
            progress(now.done, now.total, f"{now.images_per_second:.0f} images/s")
            if at.over and in_the_loop and now.phase == "train":
                signal.raise_signal(signal.SIGTERM)  # the loop saves and stops after this step
            elif at.over:
                raise TrainingInterrupted

        learnt, config = plan.train[job.where], plan.configuration(job.method, job.where, job.seed)
        result = train_run(
            learnt.data, out=run, config=config, resume=resume, dataset=learnt.dataset, limit=learnt.limit,
            device=at.device, page=False, progress=watch,
        )  # fmt: skip
        if result.stopped == "collapse":
            signs = "; ".join(f"{finding.sign}: {finding.text}" for finding in result.findings)
            raise Collapsed(f"stopped by the watcher after {result.images:,} images ({signs})")
        facts = {"images": result.images, "seconds": result.seconds, "stopped": result.stopped}
    elif job.seed:
        raise ValueError(f"{run} is one run: give seeds: 1, or let {job.method} be trained here")
    model = as_model(run, device="cpu") if kind == OURS else load_baseline(run, kind)
    return {"run": str(run), "parameters": parameter_count(model), **run_progress(run), **facts}


def embed(at: Comparison, job: Job, progress: Callable[..., None]) -> Facts:
    """Write the feature table of a scored set by one method."""
    plan, method, kind = at.plan, at.plan.methods[job.method], at.plan.kind(job.method)
    source = str(at.result(job.after[0])) if job.after else plan.methods[plan.source(job.method)].model
    net, size, chosen = None, plan.image_size, method.features or None
    if kind == OURS:
        net = as_model(str(source), device=at.device)
        net = net if method.whitened else net.without_features()
    elif kind not in CONTROLS:
        net = open_baseline(kind, source, device=at.device, features=chosen, image_size=size)
    images = _scored_images(at, job, size if net is None else net.image_size, source if job.after else None)

    def watch(done: int, total: int) -> None:
        progress(done, total)
        if at.over and done < total:
            raise TrainingInterrupted

    began = time.perf_counter()
    if net is None:
        table = control_features(kind, images, components=COMPONENTS, seed=job.seed, progress=watch)
    else:
        table = embed_image_set(net, images, progress=watch)
    seconds = time.perf_counter() - began
    table.write(at.result(job))
    factors = method.features or (("geometry", "albedo") if kind == OURS else tuple(table.factors))
    parameters = None if net is None else parameter_count(net)
    return {"factors": factors, "parameters": parameters, "seconds_a_picture": seconds / len(table)}


def score(at: Comparison, job: Job, progress: Callable[..., None]) -> Facts:
    """Score the finished methods on one set, beside controls; the others' notes say why they are missing."""
    plan, scored, rows = at.plan, at.plan.score[job.where], []
    seeds, cache = plan.untrained_seeds, at.path / "memory"
    how = Options(untrained_seeds=seeds, resamples=plan.resamples, device=at.device, cache=cache)
    for method in plan.rows():
        notes = {one: at.note(one) for one in job.after if one.method == method}
        done = {one: note.facts for one, note in notes.items() if note is not None and note.state == "done"}
        if done:
            tables = tuple(FeatureTable.read(at.result(one)) for one in done)
            factors = tuple(next(iter(done.values()))["factors"])
            rows.append(FeatureRow(method, tables, factors, "control" in tables[0].origin))
    settings = architecture(rows) or with_changes(MODEL_PRESETS["small"], [f"image_size={plan.image_size}"])
    images = _scored_images(at, job, settings.network.image_size)
    images = aligned(images, rows[0].tables[0].files) if rows else images
    rows += control_rows(images, settings, how)
    table, results = rows[0].tables[0], []
    labels, rules = scored.label, scored.model_dump(include={"mean_by", "min_count", "max_count"})
    if labels == (ATTRIBUTES,):
        labels, _ = chosen_labels(table, None, True)
    questions = {job.where: (labels, rules)}
    if scored.table is not None:
        parts = [part for part in TABLES[scored.table].parts if part.columns(table)]
        if not parts:
            have = ", ".join(table.labels) or "none"
            raise ValueError(f"table {scored.table!r} needs other labels than {scored.data} has ({have})")
        names = {part.name: f"{job.where} {part.name}" if len(parts) > 1 else job.where for part in parts}
        questions = {names[part.name]: (part.columns(table), part.rows(table)) for part in parts}
    for name, (columns, rules) in questions.items():
        ready = prepare(rows, columns, **rules)
        for protocol in scored.protocols:
            if protocol == "cluster":
                result = compare_clusterings(
                    ready.features, ready.labels, controls=ready.controls, method=plan.clustering,
                    resample_count=plan.resamples, memory=how.memory,
                )  # fmt: skip
            else:
                result = compare_prepared(ready, plan.counts, how.seeds(plan.draws), how)
            numbers = {key: value for key, value in result.numbers().items() if key != "per_label"}
            results.append(plain({"name": name, "protocol": protocol, **numbers}))
    widths = {row.name: int(row.tables[0].concatenate(row.factors).shape[1]) for row in rows}
    untrained = parameter_count(Derenderer.seeded(settings, 0))
    return {"questions": results, "numbers": widths, "untrained": untrained}


def _scored_images(at: Comparison, job: Job, image_size: int, run: str | None = None) -> ImageSet:
    """The images to score: all, or a part of the training set's split, which ``run`` must have kept."""
    scored = at.plan.score[job.where]
    images = as_images(scored.data, image_size, dataset=scored.dataset, limit=scored.limit)
    if scored.part == "all":
        return images
    wanted = SplitRecord(at.plan.train[str(scored.trained_on)].split, 0)
    kept = wanted if run is None else split_of(run) or wanted
    if kept != wanted:
        raise ValueError(
            f"{run} was trained with split {list(kept.shares)} and seed {kept.seed}, the plan's is "
            f"{list(wanted.shares)} and 0: part {scored.part} would hold images that it saw"
        )
    rows = getattr(split_indices(images.files, wanted.shares, seed=0), scored.part)
    return images.select(rows).require(2, f"the {scored.part} part")


def run_progress(run: Path) -> Facts:
    """Images seen and seconds of training by the last checkpoint; None where there is none."""
    try:
        state = read_json(run / "checkpoints" / "last" / "state.json", dict[str, Any])["state"]
        return {"images": state["images"], "seconds": state["seconds"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {"images": None, "seconds": None}


def parameter_count(model: Any) -> int:
    """Numbers that are learned, of all networks."""
    return sum(values.numel() for values in model.parameters())
