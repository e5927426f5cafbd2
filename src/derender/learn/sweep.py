"""A comparison by plan: the library's calls for every method and data set, each done once.

A training and a feature table leave a note in ``jobs``: a hash of their inputs, and the reason if they
failed. What is done is not repeated while its inputs stay the same; a training that was stopped continues.
Scores are made of the tables that are there, and cached in ``memory``. A method that failed is a row with its
reason.
"""

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from derender.baselines import CONTROLS, control_features, load_baseline, open_baseline
from derender.data import ImageSet, split_indices
from derender.data.source import stamps_of
from derender.evaluation.clustering import clustering_table, compare_clusterings
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS
from derender.evaluation.controls import architecture, control_rows
from derender.evaluation.feature_rows import FeatureRow, Prepared, chosen_labels, prepare
from derender.evaluation.linear_probing import LINEAR_COLUMNS, compare_prepared, linear_tables
from derender.evaluation.memory import content_hash
from derender.evaluation.options import Options, aligned
from derender.evaluation.paper_tables import ATTRIBUTES, TABLES
from derender.evaluation.score_table import Scores, ScoreTable, verdict_table
from derender.features import FeatureTable, embed_image_set
from derender.inputs import as_images, as_model, split_of
from derender.learn.plan import OURS, WITHOUT_LOOP, Plan, ScoredSet, read_plan
from derender.learn.runs import train as train_run
from derender.presets import MODEL_PRESETS
from derender.report.comparison import Question, comparison_page, summary_table
from derender.settings import Settings, plain
from derender.storage.atomic import write_whole
from derender.storage.bounded import read_json
from derender.storage.folder import SplitRecord
from derender.training.config import to_yaml, with_changes

COMPONENTS = 64  # of pca and noise
SHOWN_HEAD = "logistic"  # of the linear protocol, in the summary
Bar = Callable[..., Any]


class Collapsed(ValueError):
    """A training that would collapse again."""


@contextmanager
def no_bar(text: str, unit: str) -> Iterator[Callable[..., None]]:
    """No progress bar."""
    yield lambda *done, **more: None


@dataclass(frozen=True)
class Job:
    """One training on a training set, or one feature table of a scored set by the network of a training."""

    kind: Literal["train", "embed"]
    method: str
    where: str
    seed: int = 0
    training: "Job | None" = None

    @property
    def name(self) -> str:
        """In words."""
        run = f"seed {self.seed}" if self.seed else ""
        relation = "on" if self.kind == "train" else "of"
        return " ".join(filter(None, (self.kind, self.method, run, relation, self.where)))

    @property
    def slug(self) -> str:
        """As a file's name; no two jobs of a plan share one."""
        words = "-".join((self.kind, self.where, self.method, str(self.seed)))
        return f"{re.sub('[^A-Za-z0-9]+', '-', words)}-{content_hash({'name': words})[:6]}"


class Note(Settings):
    """How a job ended: ``why`` it failed, "" where it did not, and whether it would fail again."""

    job: str
    key: str
    why: str = ""
    final: bool = False


def jobs_of(plan: Plan) -> list[Job]:
    """All of a plan's jobs, each after the training that it needs."""
    jobs: dict[Job, None] = {}
    for name, scored in plan.score.items():
        for method in plan.rows():
            trained = plan.is_trained(method)
            for seed in range(plan.seeds if trained else 1):
                training = Job("train", plan.source(method), str(scored.trained_on), seed)
                jobs |= {training: None} if trained else {}
                jobs[Job("embed", method, name, seed, training if trained else None)] = None
    return list(jobs)


@dataclass(frozen=True)
class Comparison:
    """A plan in its folder; ``tell`` is called with a sentence when a job ends."""

    plan: Plan
    path: Path
    device: str = "auto"
    tell: Callable[[str], object] = lambda text: None
    bar: Bar = no_bar

    def result(self, job: Job) -> Path:
        """The run folder of a training, or the table of features."""
        if job.kind == "embed":
            return self.path / "features" / f"{job.slug}.parquet"
        name = job.method if job.seed == 0 else f"{job.method}-seed{job.seed}"
        given = self.plan.methods[job.method].runs.get(job.where)
        return self.path / "runs" / job.where / name if given is None else Path(given)

    def note(self, job: Job) -> Note | None:
        """The note that a job left; None without one that can be read."""
        try:
            return read_json(self.path / "jobs" / f"{job.slug}.json", Note)
        except (FileNotFoundError, ValueError):
            return None

    def do(self, job: Job) -> Note:
        """Do a job that is not done yet, and leave its note, whatever happens in it."""
        note, key = self.note(job), self.key(job)
        if (
            note is not None
            and note.key == key
            and (note.final or (not note.why and self.result(job).exists()))
        ):
            return note
        before = None if job.training is None else self.note(job.training)
        if before is not None and before.why:  # it has been told of the training
            note = Note(job=job.name, key=key, why=before.why, final=before.final)
        else:
            note = Note(job=job.name, key=key, **self._tried(job))
            self.tell(f"{job.name}: {f'failed: {note.why}' if note.why else 'done'}")
        write_whole(self.path / "jobs" / f"{job.slug}.json", note.model_dump_json(indent=1))
        return note

    def _tried(self, job: Job) -> dict[str, Any]:
        """Why a job failed, and whether it would again; empty where it did not."""
        try:
            with self.bar(job.name, unit="images") as progress:
                (train if job.kind == "train" else embed)(self, job, progress)
        except Exception as error:
            why, kind = " ".join(str(error).split()), type(error).__name__
            if not why or not isinstance(error, ValueError | OSError):
                why = f"{kind}: {why}".rstrip(": ")
            return {"why": why, "final": isinstance(error, Collapsed)}
        return {}

    def key(self, job: Job) -> str:
        """Changes with the settings and files of a job, and with the result of its training."""
        plan, method, run = self.plan, self.plan.methods[job.method], self.result(job)
        source = plan.train[job.where] if job.kind == "train" else plan.score[job.where]
        files = [Path(source.data.partition("::")[0])]
        if job.kind == "embed":
            model = plan.methods[plan.source(job.method)].model
            how = [plan.kind(job.method), model, method.features, method.whitened, plan.image_size]
        elif job.where in method.runs:
            how = str(run)
            files += [run / "model" / "model.safetensors", run / "model.safetensors"]
        else:
            how = plan.configuration(job.method, job.where, job.seed).model_dump(mode="json")
        times = stamps_of(file for file in files if file.is_file()).tolist()
        before = None if job.training is None else self.note(job.training)
        images = source.model_dump(mode="json", include={"data", "dataset", "limit", "part", "split"})
        trained = None if before is None else [before.key, before.why]
        return content_hash({"images": images, "how": how, "files": times, "before": trained})


def train(at: Comparison, job: Job, progress: Callable[..., None]) -> None:
    """Train, or resume, or see that the run that is there can be opened."""
    plan, run, kind = at.plan, at.result(job), at.plan.kind(job.method)
    if job.where not in plan.methods[job.method].runs:
        resume = kind not in WITHOUT_LOOP and (run / "config.yaml").is_file()
        if run.exists() and not resume:  # killed at its very beginning, or nothing to go on with
            shutil.rmtree(run)
        learnt, config = plan.train[job.where], plan.configuration(job.method, job.where, job.seed)
        result = train_run(
            learnt.data, out=run, config=config, resume=resume, dataset=learnt.dataset, limit=learnt.limit,
            device=at.device, page=False,
            progress=lambda now: progress(now.done, now.total, f"{now.images_per_second:.0f} images/s"),
        )  # fmt: skip
        if result.stopped == "collapse":
            signs = "; ".join(f"{finding.sign}: {finding.text}" for finding in result.findings)
            raise Collapsed(f"stopped by the watcher after {result.images:,} images ({signs})")
    elif job.seed:
        raise ValueError(f"{run} is one run: give seeds: 1, or let {job.method} be trained here")
    as_model(run, device="cpu") if kind == OURS else load_baseline(run, kind)


def embed(at: Comparison, job: Job, progress: Callable[..., None]) -> None:
    """Write the feature table of a scored set by one method."""
    plan, method, kind = at.plan, at.plan.methods[job.method], at.plan.kind(job.method)
    source = str(at.result(job.training)) if job.training else plan.methods[plan.source(job.method)].model
    net, size = None, plan.image_size
    if kind == OURS:
        net = as_model(str(source), device=at.device)
        net = net if method.whitened else net.without_features()
    elif kind not in CONTROLS:
        chosen = method.features or None
        net = open_baseline(kind, source, device=at.device, features=chosen, image_size=size)
    run = source if job.training else None
    images = scored_images(plan, plan.score[job.where], size if net is None else net.image_size, run)
    if net is None:
        how = {"components": COMPONENTS, "seed": job.seed, "progress": progress}
        control_features(kind, images, **how).write(at.result(job))
    else:
        embed_image_set(net, images, progress=progress).write(at.result(job))


def scored_images(plan: Plan, scored: ScoredSet, image_size: int, run: str | None = None) -> ImageSet:
    """The images to score: all, or a part of the training set's split, which ``run`` must have kept."""
    images = as_images(scored.data, image_size, dataset=scored.dataset, limit=scored.limit)
    if scored.part == "all":
        return images
    wanted = SplitRecord(plan.train[str(scored.trained_on)].split, 0)
    kept = wanted if run is None else split_of(run) or wanted
    if kept != wanted:
        raise ValueError(
            f"{run} was trained with split {list(kept.shares)} and seed {kept.seed}, the plan's is "
            f"{list(wanted.shares)} and 0: part {scored.part} would hold images that it saw"
        )
    rows = getattr(split_indices(images.files, wanted.shares, seed=0), scored.part)
    return images.select(rows).require(2, f"the {scored.part} part")


def prepared(at: Comparison, name: str, done: Sequence[Job], how: Options) -> dict[str, Prepared]:
    """A scored set's questions by name: the tables that are there and the controls, side by side."""
    plan, scored, rows = at.plan, at.plan.score[name], []
    for method in plan.rows():
        tables = tuple(FeatureTable.read(at.result(job)) for job in done if job.method == method)
        if tables:
            ours = ("geometry", "albedo") if plan.kind(method) == OURS else tuple(tables[0].factors)
            factors = plan.methods[method].features or ours
            rows.append(FeatureRow(method, tables, factors, "control" in tables[0].origin))
    settings = architecture(rows) or with_changes(MODEL_PRESETS["small"], [f"image_size={plan.image_size}"])
    images = scored_images(plan, scored, settings.network.image_size)
    images = aligned(images, rows[0].tables[0].files) if rows else images
    rows += control_rows(images, settings, how)
    table = rows[0].tables[0]
    if scored.table is None:
        labels = chosen_labels(table, None, True)[0] if scored.label == (ATTRIBUTES,) else scored.label
        rules = scored.model_dump(include={"mean_by", "min_count", "max_count"})
        return {name: prepare(rows, labels, **rules)}
    parts = [part for part in TABLES[scored.table].parts if part.columns(table)]
    if not parts:
        have = ", ".join(table.labels) or "none"
        raise ValueError(f"table {scored.table!r} needs other labels than {scored.data} has ({have})")
    names = {part.name: f"{name} {part.name}" if len(parts) > 1 else name for part in parts}
    return {names[part.name]: prepare(rows, part.columns(table), **part.rows(table)) for part in parts}


def score(
    plan: Plan, name: str, protocol: str, ready: Prepared, how: Options, absent: Mapping[str, str]
) -> tuple[list[Question], list[ScoreTable], dict[str, Any]]:
    """One question under one protocol: its parts for the summary, its own tables, and all numbers."""
    if protocol == "cluster":
        result: Any = compare_clusterings(
            ready.features, ready.labels, controls=ready.controls, method=plan.clustering,
            resample_count=plan.resamples, memory=how.memory,
        )  # fmt: skip
        tables = [
            clustering_table(result),
            verdict_table(result.rows, CLUSTER_COLUMNS, "Above the controls?"),
        ]
        main = {score: CLUSTER_COLUMNS[score] for score in ("accuracy", "nmi")}
        shown = [Question(name, main, {row.name: row for row in result.rows}, absent)]
    else:
        result, main = compare_prepared(ready, plan.counts, how.seeds(plan.draws), how), {}
        main["balanced_accuracy"] = LINEAR_COLUMNS["balanced_accuracy"]
        tables = linear_tables(result)
        shown = [
            Question(f"{name}, {part.count:,} labels", main, {row.name: row for row in part.rows}, absent)
            for part in result.parts
            if part.head == SHOWN_HEAD
        ]
    own = [replace(table, caption=f"{name}: {table.caption}") for table in tables]
    return shown, own, {"name": name, "protocol": protocol, "absent": absent, **result.numbers()}


def compare_plan(
    plan: Plan | str | Path, out: str | Path, *, device: str = "auto",
    tell: Callable[[str], object] = lambda text: None, bar: Bar = no_bar,
) -> Scores:  # fmt: skip
    """Train, embed and score every method of a plan, or continue, and write comparison.md, .html and .json.

    Args:
        plan: as ``learn.plan`` reads it from a YAML or TOML file, or that file.
        out: the folder of runs, features and tables.
        device: "auto", "cpu" or "cuda".
        tell: called with a sentence when a job ends.
        bar: makes the progress bar of a job, ``bar(text, unit=...)``.

    Returns:
        A summary of each protocol, then every table; ``values`` has the numbers, files, and what failed.

    Raises:
        ValueError: the plan does not fit, the folder holds something else, or another process works in it.
    """
    plan, out = (plan if isinstance(plan, Plan) else read_plan(plan)), Path(out)
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file: give the name of a folder")
    others = out.is_dir() and any(one.name[0] != "." for one in out.iterdir())  # . files: of a kill
    if others and not (out / "plan.yaml").is_file():
        raise ValueError(f"{out} is not empty and holds no comparison: choose another folder")
    write_whole(out / "plan.yaml", to_yaml(plan))
    at = Comparison(plan, out, device, tell, bar)
    try:
        with FileLock(out / ".lock", timeout=0):
            return written(at, {job: at.do(job) for job in jobs_of(plan)})
    except Timeout as error:
        raise ValueError(
            f"another derender compare works in {out}: wait for it, or choose another folder"
        ) from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("stopped and saved; the same command continues where it stopped") from stop


def written(at: Comparison, notes: Mapping[Job, Note]) -> Scores:
    """Score whatever is there, and write the tables."""
    plan, questions, own, numbers = at.plan, dict[str, list[Question]](), list[ScoreTable](), []
    failed = [  # features whose training failed are not named again
        f"{note.job}: {note.why}"
        for job, note in notes.items()
        if note.why and not (job.training and notes[job.training].why)
    ]
    for name, scored in plan.score.items():
        jobs = [job for job in notes if job.kind == "embed" and job.where == name]
        done = [job for job in jobs if not notes[job].why]
        there = {job.method for job in done}
        absent = {job.method: notes[job].why for job in jobs if job.method not in there}
        how = Options(
            untrained_seeds=plan.untrained_seeds, resamples=plan.resamples, device=at.device,
            cache=at.path / "memory",
        )  # fmt: skip
        try:
            ready = prepared(at, name, done, how)
        except ValueError as error:
            failed.append(f"score {name}: {error}")
            continue
        for protocol in scored.protocols:
            for title, one in ready.items():
                shown, tables, values = score(plan, title, protocol, one, how, absent)
                questions.setdefault(protocol, []).extend(shown)
                own += tables
                numbers.append(values)
    if not numbers:
        raise ValueError(f"nothing could be scored: {'; '.join(failed)}")
    summaries = [summary_table(protocol, asked, plan.rows()) for protocol, asked in questions.items()]
    lead = f"Every method that is trained here saw {plan.images:,} images of the same training part."
    if plan.seeds == 1:
        lead += " One training seed each: intervals speak of which images were scored, not of trainings."
    tables, files = [*summaries, *own], [at.path / f"comparison.{kind}" for kind in ("md", "html", "json")]
    values = {"failed": failed, "questions": numbers, "plan": plan.model_dump(mode="json")}
    scores = Scores(tables, {**values, "out": at.path, "files": files, "summaries": len(summaries)})
    facts = {"methods": ", ".join(plan.rows()), "images seen": f"{plan.images:,}", "seeds": plan.seeds}
    title = f"Comparison on {', '.join(plan.score)}"
    missing = "".join(f"\n- {sentence}" for sentence in failed)
    contents = (
        scores.to_markdown() + (f"\nFailed:\n{missing}\n" if failed else ""),
        comparison_page(title, tables, lead=lead, facts=facts, failed=failed).html(),
        json.dumps(plain(values), indent=1, ensure_ascii=False) + "\n",
    )
    for file, content in zip(files, contents, strict=True):
        write_whole(file, content.encode(errors="replace"))
    return scores
