"""A set of pictures in, an examination out: measures, findings, verdict, and pictures that show them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from derender.data.doctor.comparing import comparing
from derender.data.doctor.counting import counting
from derender.data.doctor.findings import Finding, Verdict, verdict_of
from derender.data.doctor.limits import LIMITS
from derender.data.doctor.measures import Measures, Shared, measure
from derender.data.doctor.originals import Originals
from derender.data.doctor.variety import own_mirror_distance
from derender.data.pictures import PictureSet

EXAMINED_PX = 64
"""Side at which pictures are read for an examination."""

SHOWN = 8
"""Pictures in each row of examples, at most."""


@dataclass(frozen=True)
class Examination:
    """What was found.

    Attributes:
        verdict: whether the set suits the method.
        findings: one for each thing that was looked at.
        measures: the numbers behind them.
        originals: sizes of the files, or None for a stream.
        examples: rows of pictures by what they show ("typical", "least typical", "one group", ...).
        mean: the distinct pictures' mean, 0..1, or None where too few were compared.
    """

    verdict: Verdict
    findings: tuple[Finding, ...]
    measures: Measures
    originals: Originals | None
    examples: Mapping[str, tuple[int, ...]]
    mean: np.ndarray | None


def examine(
    pictures: PictureSet,
    originals: Originals | None = None,
    *,
    seed: int = 0,
    progress: Callable[[int, int], object] | None = None,
) -> Examination:
    """Examine pictures that were read with ``keep_duplicates=True`` at ``EXAMINED_PX``, or a multiple of 32.

    The same pictures and seed give the same examination.
    """
    if len(pictures) == 0:
        raise ValueError(f"there is no picture to examine in {pictures.source}")
    kept = set(pictures.files)
    identical = sum(row.file in kept for row in pictures.duplicates)
    measures = measure(pictures.images, identical, np.random.default_rng(seed), progress)
    shared = measures.shared
    findings = (
        *counting(measures, len(pictures.skipped), originals),
        *comparing(shared),
    )
    return Examination(
        verdict=verdict_of(findings),
        findings=findings,
        measures=measures,
        originals=originals,
        examples=_examples(measures),
        mean=None if shared is None else pictures.images[shared.rows].mean(axis=0, dtype=np.float64) / 255,
    )


def _examples(measures: Measures) -> dict[str, tuple[int, ...]]:
    """Pictures for the page, by what they show; those of the extremes are extreme, no pick."""
    examples: dict[str, np.ndarray] = {}
    copies = np.flatnonzero(measures.group != np.arange(measures.pictures))
    if len(copies):
        pairs = [(int(measures.group[row]), int(row)) for row in _spread(copies, SHOWN // 2)]
        examples["copies, in pairs"] = np.array(pairs).ravel()
    if (blank := np.flatnonzero(measures.pixels.blank)).size:
        examples["empty"] = _spread(blank, SHOWN)
    if measures.shared is not None:
        examples |= _compared(measures.shared)
    else:
        examples["all distinct"] = _spread(np.unique(measures.group), SHOWN)
    return {name: tuple(int(row) for row in rows) for name, rows in examples.items()}


def _compared(shared: Shared) -> dict[str, np.ndarray]:
    rows, alike = shared.rows, np.argsort(shared.likeness)
    examples: dict[str, np.ndarray] = {}
    if shared.agreement.value < LIMITS.agreement_objects:
        return {"evenly through the set": _spread(rows, SHOWN)}
    examples["most typical"] = rows[alike[::-1][:SHOWN]]
    examples["least typical"] = rows[alike[:SHOWN]]
    if shared.halves is not None and shared.halves.kinship.value < LIMITS.kinship_objects:
        order = np.argsort(shared.halves.margin)
        examples["one group"] = rows[order[:SHOWN]]
        examples["the other group"] = rows[order[::-1][:SHOWN]]
    turned = np.argsort(own_mirror_distance(shared.structure))
    examples["nearest their mirror image"] = rows[turned[:SHOWN]]
    examples["farthest from it"] = rows[turned[::-1][:SHOWN]]
    lit = np.argsort(shared.sides.mean(axis=1))
    examples["brightest on the left"] = rows[lit[::-1][:SHOWN]]
    examples["brightest on the right"] = rows[lit[:SHOWN]]
    return examples


def _spread(rows: np.ndarray, count: int) -> np.ndarray:
    return rows[np.unique(np.linspace(0, len(rows) - 1, count).astype(int))]
