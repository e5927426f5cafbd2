"""What has to be done for a plan, in which order, and where it lies.

Every job leaves a note beside its result: what it was made from (a key), how it ended, what it cost. A job
whose note has the same key is not done again.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from derender.cli.plan.settings import Plan
from derender.evaluation.memory import content_hash
from derender.storage.atomic import atomic_file

Kind = Literal["train", "embed", "score"]
State = Literal["done", "failed", "stopped"]


@dataclass(frozen=True)
class Job:
    """One thing to do.

    Attributes:
        kind: what.
        method: whose; empty for scores, which are everyone's.
        where: the training set of a training, else the scored set.
        seed: of the training.
        after: jobs that must have ended, well or not.
    """

    kind: Kind
    method: str
    where: str
    seed: int = 0
    after: tuple["Job", ...] = ()

    @property
    def name(self) -> str:
        """In words."""
        what = {"train": "on", "embed": "of", "score": ""}[self.kind]
        run = f" seed {self.seed}" if self.seed else ""
        return " ".join(f"{self.kind} {self.method}{run} {what} {self.where}".split())

    @property
    def slug(self) -> str:
        """As a file's name; no two jobs of a plan share one."""
        words = "-".join((self.kind, self.where, self.method, str(self.seed)))
        return f"{re.sub('[^A-Za-z0-9]+', '-', words)}-{content_hash({'name': words})[:6]}"


@dataclass(frozen=True)
class Note:
    """How a job ended.

    Attributes:
        key: hash of what it was made from.
        state: done, failed (``why``), or stopped by the budget.
        why: one sentence, where it is not done.
        final: a failure that would come again.
        facts: what it cost and found.
    """

    key: str
    state: State
    why: str = ""
    final: bool = False
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Place:
    """The folder of a comparison."""

    path: Path

    def run(self, method: str, trained_on: str, seed: int) -> Path:
        """Where a training lies that is done here."""
        return self.path / "runs" / trained_on / (method if seed == 0 else f"{method}-seed{seed}")

    def features(self, job: Job) -> Path:
        return self.path / "features" / f"{job.slug}.parquet"

    def log(self, job: Job) -> Path:
        return self.path / "logs" / f"{job.slug}.log"

    @property
    def memory(self) -> Path:
        return self.path / "memory"

    def note(self, job: Job) -> Note | None:
        """What a job left behind; None if nothing, or nothing that can be read."""
        try:
            tree = json.loads(self._note(job).read_text())
            return Note(**{name: tree[name] for name in ("key", "state", "why", "final", "facts")})
        except (FileNotFoundError, ValueError, TypeError, KeyError):
            return None

    def forget(self, job: Job) -> None:
        """Take a job's note away, as before it is done again."""
        self._note(job).unlink(missing_ok=True)

    def leave(self, job: Job, note: Note) -> Note:
        """Write a job's note."""
        with atomic_file(self._note(job)) as temporary:
            temporary.write_text(json.dumps({"job": job.name, **asdict(note)}, indent=1))
        return note

    def _note(self, job: Job) -> Path:
        return self.path / "jobs" / f"{job.slug}.json"


def jobs_of(plan: Plan) -> list[Job]:
    """All of a plan's jobs, each after those it needs; trainings in the order of the plan's data sets."""
    found: dict[Job, None] = {}
    scores: list[Job] = []
    for name, scored in plan.score.items():
        tables = []
        for method in plan.rows():
            trained = plan.is_trained(method)
            for seed in range(plan.seeds if trained else 1):
                before: tuple[Job, ...] = ()
                if trained:
                    before = (Job("train", plan.source(method), str(scored.trained_on), seed),)
                    found[before[0]] = None
                tables.append(Job("embed", method, name, seed, before))
                found[tables[-1]] = None
        scores.append(Job("score", "", name, 0, tuple(tables)))
    return [*found, *scores]


def facts_of_file(path: str) -> list[Any]:
    """What changes when a data set's file does: its path, and size and time where it is one file."""
    file = Path(path.partition("::")[0])
    if not file.is_file():
        return [path]
    status = file.stat()
    return [path, status.st_size, status.st_mtime_ns]
