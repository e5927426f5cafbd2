"""Kinds of probe by name, with one signature: features and training rows in, probabilities out.

``linear`` is the paper's head, ``centred`` the same on features whose mean over the training rows is 0,
``logistic`` a penalised regression, ``k-NN`` the ten nearest by cosine of centred features, ``majority`` the
share of each value among the training rows, which knows no image.
"""

from collections.abc import Sequence

import numpy as np

from derender.data import suggestion
from derender.evaluation.linear_head import PAPER_HEAD, HeadSettings, train_heads
from derender.evaluation.linear_logistic import fit_logistic
from derender.evaluation.linear_task import Task
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import finite_rows

HEADS = ("linear", "logistic", "k-NN")
"""Asked where none are named."""

PROBES = ("linear", "centred", "logistic", "k-NN")
"""All there are."""

NEIGHBOURS = 10
_PAPERS = ("linear", "centred")


def probe(
    head: str,
    features: np.ndarray,
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    seeds: Sequence[int],
    *,
    settings: HeadSettings = PAPER_HEAD,
    memory: Memory | None = None,
) -> np.ndarray:
    """Learn from some rows and answer for others, once for each seed: (S, T, A) float32 probabilities.

    Args:
        head: one of ``PROBES``.
        features: (N, D), finite.
        task: targets of the N rows.
        rows: (S, n) training rows.
        tested: (T,) rows to answer for; they take no part in any choice.
        seeds: (S,) of starts and folds.
        settings: of the paper's head.
        memory: where answers are kept.
    """
    check_head(head)
    features = finite_rows(features, "a linear probe").astype(np.float32)
    inputs = {
        "features": features,
        "targets": task.targets,
        "kind": task.kind,
        "rows": rows,
        "tested": tested,
        "seeds": list(seeds),
        "settings": settings.model_dump() if head in _PAPERS else {},
    }

    def make() -> dict[str, np.ndarray]:
        if head in _PAPERS:
            answers = train_heads(
                features, task.targets, rows, tested,
                kind=task.kind, seeds=seeds, settings=settings, centred=head == "centred",
            )  # fmt: skip
        elif head == "logistic":
            answers = np.stack(
                [
                    fit_logistic(
                        features[own], task.targets[own], features[tested], kind=task.kind, seed=seed
                    )[0]
                    for own, seed in zip(rows, seeds, strict=True)
                ]
            )
        else:
            answers = np.stack(
                [nearest_answers(features[own], task.targets[own], features[tested]) for own in rows]
            )
        return {"probabilities": answers.astype(np.float32)}

    return (memory or Memory()).recall(f"probe-{head}", inputs, make)["probabilities"]


def probe_runs(
    head: str,
    arrays: Sequence[np.ndarray],
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    seeds: Sequence[int],
    settings: HeadSettings,
    memory: Memory | None,
) -> np.ndarray:
    """(S, T, A) answers; seeds that share a run are trained together."""
    answers: list[np.ndarray | None] = [None] * len(seeds)
    for run, array in enumerate(arrays):
        mine = [at for at in range(len(seeds)) if at % len(arrays) == run]
        if mine:
            own = [seeds[at] for at in mine]
            found = probe(head, array, task, rows[mine], tested, own, settings=settings, memory=memory)
            for at, answer in zip(mine, found, strict=True):
                answers[at] = answer
    return np.stack([answer for answer in answers if answer is not None])


def check_head(head: str) -> None:
    """A kind of probe that is none is an error that names the nearest."""
    if head not in PROBES:
        raise ValueError(f"unknown head {head!r}{suggestion(head, PROBES)}; there is {', '.join(PROBES)}")


def nearest_answers(
    features: np.ndarray, targets: np.ndarray, tested: np.ndarray, neighbours: int = NEIGHBOURS
) -> np.ndarray:
    """Share of each value among the nearest training rows by cosine: (T, A), 0.5 where all are unknown."""
    mean = features.mean(axis=0)
    near, far = (_unit(np.asarray(rows, np.float64) - mean) for rows in (features, tested))
    count = min(neighbours, len(near))
    found = np.argsort(-(far @ near.T), axis=1, kind="stable")[:, :count]
    values, known = targets[found], targets[found] >= 0
    total = known.sum(axis=1)
    return np.divide((values * known).sum(axis=1), total, out=np.full(total.shape, 0.5), where=total > 0)


def majority_answers(task: Task, rows: np.ndarray, n_tested: int) -> np.ndarray:
    """The share of each value among the training rows, for everybody: (S, T, A)."""
    values, known = task.targets[rows], task.targets[rows] >= 0
    total = known.sum(axis=1)
    share = np.divide((values * known).sum(axis=1), total, out=np.full(total.shape, 0.5), where=total > 0)
    return np.repeat(share[:, None].astype(np.float32), n_tested, axis=1)


def _unit(rows: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
