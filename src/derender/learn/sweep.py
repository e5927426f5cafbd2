"""A comparison by plan: trainings, feature tables and scores, one after another.

A job is done when its file is there; the file's name has a hash of everything that decides the result. A
training that was stopped continues from its last checkpoint. A job that fails costs its own rows alone, and
is done again by the same command. The tables are made anew from the files of all scores.
"""

import json
import os
import re
import shutil
import traceback
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from pydantic_core import to_jsonable_python

from derender.baselines import CONTROLS, control_features, open_baseline
from derender.data import ImageSet
from derender.data.source import stamps_of
from derender.evaluation.clustering import clustering_tables, compare_clusterings
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS
from derender.evaluation.feature_rows import FeatureRow, architecture, chosen_labels, control_rows, prepare
from derender.evaluation.linear_probing import LINEAR_COLUMNS, compare_prepared, linear_tables
from derender.evaluation.memory import content_hash
from derender.evaluation.options import Options, aligned
from derender.evaluation.paper_tables import ATTRIBUTES, TABLES
from derender.evaluation.score_table import Row, Scores, ScoreTable
from derender.features import FeatureTable, embed_image_set
from derender.inputs import as_images, as_model, split_of
from derender.learn.plan import OURS, WITHOUT_LOOP, ImageSource, Plan, ScoredSet, read_plan
from derender.learn.runs import train
from derender.report.protocols import comparison_page
from derender.settings import plain
from derender.storage.atomic import measured, write_whole
from derender.storage.bounded import read_json
from derender.storage.folder import SplitRecord
from derender.storage.places import WEIGHTS_FILE
from derender.training.config import resolve, to_yaml

SCORING = {"clustering", "counts", "draws", "untrained_seeds", "resamples", "image_size"}
SUMMARY_HEAD, BALANCED = "logistic", "balanced_accuracy"  # of the linear protocol, in its summary
SUMMARY = {
    "cluster": ("Clustering", {score: CLUSTER_COLUMNS[score] for score in ("accuracy", "nmi")}),
    "linear": ("Few labels, penalised logistic regression", {BALANCED: LINEAR_COLUMNS[BALANCED]}),
}
DONE, TO_DO, FAILED = "done", "to do", "failed: "
Show = Callable[..., None]  # called with (done, total), perhaps a note, ``description=`` and ``unit=``


def no_bar(text: str, unit: str) -> AbstractContextManager[Show]:
    """No progress bar."""
    return nullcontext(lambda *done, **more: None)


@dataclass(frozen=True)
class Question:
    """One question of a scored set under one protocol: its numbers, and its tables with every score."""

    name: str
    protocol: str
    numbers: dict[str, Any]
    tables: list[ScoreTable]


@dataclass
class Sweep:
    """A plan in its folder; ``states`` says of each job whether it is done or to do, or why it failed.

    ``dry`` only looks at what is there; other fields are arguments of `compare_plan`.
    """

    plan: Plan
    out: Path
    dry: bool = False
    device: str = "auto"
    tell: Callable[[str], object] = lambda text: None
    bar: Callable[..., Any] = no_bar
    states: dict[str, str] = field(default_factory=dict)

    def jobs(self) -> list[Path]:
        """Do, or look at, every job, set after set; gives the files of scores."""
        plan, files = self.plan, []
        for name, scored in plan.score.items():
            tables: dict[str, list[Path]] = defaultdict(list)
            for method in plan.rows():
                origin, trained = plan.source(method), plan.is_trained(method)
                for seed in range(plan.seeds if trained else 1):
                    made = (plan.methods[origin].model, None)
                    if trained:
                        made = self.train(origin, str(scored.trained_on), seed)
                    if made and (table := self.embed(method, name, seed, *made)):
                        tables[method].append(table)
            how = [plan.model_dump(include=SCORING), scored.model_dump(), _read(scored)]
            how += [(method, [table.name for table in own]) for method, own in tables.items()]
            if file := self.done(f"score {name}", partial(self.score, name, tables), "jobs/{}.json", how):
                files.append(file)
        return files

    def done(self, job: str, work: Callable[[Path, Show], None], name: str, inputs: object) -> Path | None:
        """Do a job unless its file is there; gives the file, None if the job failed."""
        slug = re.sub("[^A-Za-z0-9]+", "-", job)
        file = self.out / name.format(f"{slug}-{content_hash({job: inputs})[:8]}")
        if job not in self.states:
            self.states[job] = DONE if file.exists() else TO_DO
            if self.states[job] == TO_DO and not self.dry:
                try:
                    with self.bar(job, unit="images") as show:
                        work(file, show)
                    self.states[job] = DONE
                except Exception as error:
                    write_whole(self.out / "logs" / f"{slug}.log", traceback.format_exc())
                    kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
                    self.states[job] = f"{FAILED}{kind}{' '.join(str(error).split())}"
                self.tell(f"{job}: {self.states[job]}")
        return None if self.states[job].startswith(FAILED) else file

    def train(self, method: str, where: str, seed: int) -> tuple[str, str | None] | None:
        """The run folder of a training, and its job's file by name if it was made here; None if it failed."""
        plan, learnt = self.plan, self.plan.train[where]
        if where in plan.methods[method].runs:
            return plan.methods[method].runs[where], None
        config = plan.configuration(method, where, seed)
        run = self.out / "runs" / where / (f"{method}-seed{seed}" if seed else method)
        job = f"train {method} on {where}{f', seed {seed}' if seed else ''}"

        def work(file: Path, show: Show) -> None:
            resume = plan.kind(method) not in WITHOUT_LOOP and (run / "config.yaml").is_file()
            if run.exists() and not resume:  # killed at its very beginning, or nothing to continue
                shutil.rmtree(run)
            result = train(
                learnt.data, out=run, config=config, resume=resume, dataset=learnt.dataset,
                limit=learnt.limit, device=self.device, page=False,
                progress=lambda now: show(now.done, now.total, f"{now.images_per_second:.0f} images/s"),
            )  # fmt: skip
            if result.stopped == "collapse":
                signs = "; ".join(f"{finding.sign}: {finding.text}" for finding in result.findings)
                raise ValueError(f"stopped by the watcher after {result.images:,} images ({signs})")
            write_whole(file, json.dumps({"images": result.images, "seconds": result.seconds}))

        inputs = [_read(learnt), config.model_dump(mode="json")]
        file = self.done(job, work, "jobs/{}.json", inputs)
        return (str(run), file.name) if file else None

    def embed(self, method: str, where: str, seed: int, model: str | None, by: str | None) -> Path | None:
        """The feature table of a scored set by one method; job ``by`` made its model. None if it failed."""
        plan, own, scored = self.plan, self.plan.methods[method], self.plan.score[where]
        kind, split = plan.kind(method), self.split(scored)
        job = f"embed {method} of {where}{f', seed {seed}' if seed else ''}"

        def work(file: Path, show: Show) -> None:
            if kind in CONTROLS:
                control_features(kind, self.images(scored, plan.image_size), progress=show).write(file)
                return
            if kind == OURS:
                net = as_model(str(model), device=self.device)
                net = net if own.whitened else net.without_features()
            else:
                how = {"features": own.features or None, "image_size": plan.image_size}
                net = open_baseline(kind, model, device=self.device, **how)
            if scored.part != "all" and plan.is_trained(method) and split_of(str(model)) not in (split, None):
                raise ValueError(f"{model} has another split than the plan and may have seen these images")
            embed_image_set(net, self.images(scored, net.image_size), progress=show).write(file)

        files = [Path(model or os.devnull, inner, WEIGHTS_FILE) for inner in ("", "model")]
        weights = by or [measured(file) for file in files if file.is_file()]
        inputs = [_read(scored), scored.part, plain(split), kind, own.features, own.whitened, plan.image_size]
        return self.done(job, work, "features/{}.parquet", [*inputs, model, weights])

    def split(self, scored: ScoredSet) -> SplitRecord | None:
        """The split whose part is scored."""
        learnt = self.plan.train.get(scored.trained_on or "")
        return None if learnt is None else SplitRecord(learnt.split, 0)

    def images(self, scored: ScoredSet, size: int) -> ImageSet:
        """The images to score, ``size`` pixels a side."""
        how = {"dataset": scored.dataset, "limit": scored.limit, "part": scored.part}
        return as_images(scored.data, size, **how, model=self.split(scored))

    def score(self, name: str, tables: Mapping[str, Sequence[Path]], file: Path, show: Show) -> None:
        """Write the scores of one set by all methods that have features, beside controls."""
        plan, scored, rows, questions = self.plan, self.plan.score[name], [], []
        counts = plan.model_dump(include={"untrained_seeds", "resamples"})
        how = Options(**counts, device=self.device, cache=self.out / "memory", progress=show)
        for method, files in tables.items():
            runs = tuple(map(FeatureTable.read, files))
            factors = plan.methods[method].features or (how.chosen if plan.kind(method) == OURS else None)
            rows.append(FeatureRow(method, runs, factors, "control" in runs[0].origin))
        settings = architecture(rows) or resolve("small", [f"image_size={plan.image_size}"]).model
        images = self.images(scored, settings.network.image_size)
        images = aligned(images, rows[0].tables[0].files) if rows else images
        rows += control_rows(images, settings, how)
        table, kept = rows[0].tables[0], {"mean_by", "min_count", "max_count"}
        rules, asked = scored.model_dump(include=kept, exclude_defaults=True), {}
        if scored.table is None:
            labels = chosen_labels(table, None, True)[0] if scored.label == (ATTRIBUTES,) else scored.label
            asked[name] = labels, rules
        else:
            parts = [part for part in TABLES[scored.table].parts if part.columns(table)]
            for part in parts:
                title = f"{name} {part.name}" if len(parts) > 1 else name
                asked[title] = part.columns(table), part.rows(table) | rules
        if not asked:
            have = ", ".join(table.labels) or "none"
            raise ValueError(f"table {scored.table!r} needs other labels than {scored.data} has ({have})")
        for title, (columns, rules) in asked.items():
            ready = prepare(rows, columns, **rules)
            for protocol in scored.protocols:
                if protocol == "cluster":
                    result = compare_clusterings(**ready.asked, method=plan.clustering, **how.scoring)
                    own = clustering_tables(result, "above the strongest control?")
                else:
                    result = compare_prepared(ready, plan.counts, how.seeds(plan.draws), how)
                    own = linear_tables(result)
                own = [replace(one, caption=f"{title}: {one.caption}") for one in own]
                numbers = {key: value for key, value in result.numbers().items() if key != "per_label"}
                questions.append(Question(title, protocol, plain(numbers), own))
        write_whole(file, json.dumps(to_jsonable_python(questions, inf_nan_mode="constants")))

    def write(self, files: Sequence[Path]) -> Scores:
        """Write comparison.md, .html and .json; gives a summary of each protocol, then every table."""
        plan, names = self.plan, [self.out / f"comparison.{form}" for form in ("md", "html", "json")]
        questions = [question for file in files for question in read_json(file, list[Question], "delete it")]
        failed = [f"{job}: {why.removeprefix(FAILED)}" for job, why in self.states.items() if FAILED in why]
        if not questions:
            raise ValueError(f"nothing could be scored: {'; '.join(failed)}")
        asked = {kind: [one for one in questions if one.protocol == kind] for kind in SUMMARY}
        summaries = [summary_table(kind, own, plan.rows()) for kind, own in asked.items() if own]
        tables = [*summaries, *(table for question in questions for table in question.tables)]
        lead = f"Every method that is trained here saw {plan.images:,} images of the same training part"
        lead += f", in {plan.seeds} seeds. " if plan.seeds > 1 else ". One training seed each. "
        lead += "Intervals speak of which images were scored, not of trainings."
        facts, title = {"seeds": plan.seeds, **plan.settings}, f"Comparison on {', '.join(plan.score)}"
        numbers = [{"name": one.name, "protocol": one.protocol, **one.numbers} for one in questions]
        values = {"failed": failed, "questions": numbers, "plan": plan.model_dump(mode="json")}
        contents = (
            "\n".join([Scores(tables, {}).to_markdown(), *(f"- failed: {why}" for why in failed)]),
            comparison_page(title, tables, lead=lead, facts=facts, failed=failed).html(),
            json.dumps(values, indent=1, ensure_ascii=False),
        )
        for file, text in zip(names, contents, strict=True):
            write_whole(file, f"{text}\n".encode(errors="replace"))
        return Scores(tables, {**values, "out": self.out, "files": names, "summaries": len(summaries)})


def summary_table(protocol: str, questions: Sequence[Question], methods: Sequence[str]) -> ScoreTable:
    """A row for each method, then for each control, and the main scores of every question."""
    columns, cells, control, (caption, scores) = [], [], dict.fromkeys(methods, False), SUMMARY[protocol]
    for one in questions:
        for part in one.numbers.get("parts", [one.numbers]):
            if part.get("head", SUMMARY_HEAD) != SUMMARY_HEAD:
                continue
            title = f"{one.name}, {part['labels']:,} labels" if "head" in part else one.name
            control |= {name: row["control"] for name, row in part["rows"].items()}
            for score, column in scores.items():
                columns.append(replace(column, name=f"{title}: {column.name}"))
                values = {name: row["scores"][score]["value"] for name, row in part["rows"].items()}
                cells.append({**dict.fromkeys(methods, "failed"), **values})
    rows = [Row(name, [cell.get(name) for cell in cells], quiet) for name, quiet in control.items()]
    return ScoreTable(f"{caption}: all data sets", "features", columns, rows)


def _read(source: ImageSource) -> list[Any]:
    """How images are read, and the size and time of their file, if it is one."""
    file = Path(source.data.partition("::")[0])
    return [source.data, source.dataset, source.limit, stamps_of([file] if file.is_file() else []).tolist()]


def compare_plan(
    plan: Plan | str | Path, out: str | Path, *, device: str = "auto",
    tell: Callable[[str], object] = lambda text: None, bar: Callable[..., Any] = no_bar,
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
        ValueError: the plan or the folder does not fit, or nothing could be scored.
    """
    plan, out = (plan if isinstance(plan, Plan) else read_plan(plan)), Path(out)
    if out.is_file():
        raise ValueError(f"{out} is a file: give the name of a folder")
    others = out.is_dir() and any(one.name[0] != "." for one in out.iterdir())  # . files: of a kill
    if others and not (out / "plan.yaml").is_file():
        raise ValueError(f"{out} is not empty and holds no comparison: choose another folder")
    write_whole(out / "plan.yaml", to_yaml(plan))
    sweep = Sweep(plan, out, False, device, tell, bar)
    try:
        with FileLock(out / ".lock", timeout=0):
            return sweep.write(sweep.jobs())
    except Timeout as error:
        raise ValueError(f"another derender compare works in {out}: choose another folder") from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("stopped and saved; the same command continues where it stopped") from stop


def states_of(plan: Plan, out: str | Path | None = None) -> dict[str, str]:
    """Every job of a plan in its folder: ``done`` or ``to do``."""
    sweep = Sweep(plan, Path(out or os.devnull), dry=True)
    sweep.jobs()
    return sweep.states
