"""One kind of thing or two, and which pictures are unlike all others.

Structure is made blind to left and right first (a car seen from either side is one kind), then split in two
by k-means on half of the pictures; the other half is dealt out and judged. Leaves out more than two kinds:
three show as two of them joined, which still have little in common with the third.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from derender.data.doctor.estimate import Estimate
from derender.data.doctor.structure import agreement, mirrored

SPLITS = 8
_COMPONENTS, _STARTS, _ROUNDS, _SMALLEST = 16, 3, 25, 5


@dataclass(frozen=True)
class Halves:
    """The two most different groups.

    Attributes:
        kinship: agreement across the groups over agreement within them; 1 one kind, 0 nothing shared. Median
            over random splits, with their standard deviation as its error.
        smaller: share of the pictures in the smaller group, 0..0.5.
        margin: how clearly each picture is in one group (negative) or the other, in standard deviations.
    """

    kinship: Estimate
    smaller: float
    margin: Float[np.ndarray, " n"]


def split_in_two(structure: Float32[np.ndarray, "n 6 6 8"], generator: np.random.Generator) -> Halves | None:
    """Judge the two most different groups; None where no split leaves both large enough to judge."""
    blind = structure + mirrored(structure)
    blind = blind / np.maximum(np.sqrt((blind**2).sum(axis=(1, 2, 3), keepdims=True)), 1e-6)
    kinships, shares, place = [], [], np.zeros(len(blind))
    for _ in range(SPLITS):
        order = generator.permutation(len(blind))
        fit, judged = blind[order[::2]], blind[order[1::2]]
        along, bias = _two_means(fit.reshape(len(fit), -1), generator)
        place = blind.reshape(len(blind), -1) @ along - bias
        second = place[order[1::2]] > 0
        first_group, second_group = judged[~second], judged[second]
        if min(len(first_group), len(second_group)) < _SMALLEST:
            continue
        across = float((first_group.mean(axis=0) * second_group.mean(axis=0)).sum())
        within = max(agreement(first_group), 1e-3) * max(agreement(second_group), 1e-3)
        kinships.append(across / np.sqrt(within))
        shares.append(min(second.mean(), 1 - second.mean()))
    if len(kinships) < SPLITS // 2:
        return None
    kinship = Estimate(float(np.median(kinships)), float(np.std(kinships)))
    return Halves(kinship, float(np.median(shares)), place / max(float(place.std()), 1e-9))


def likeness(structure: Float32[np.ndarray, "n 6 6 8"]) -> Float[np.ndarray, " n"]:
    """Cosine of each picture with the mean direction of the others; about 0 for a stranger among them.

    Where the pictures agree at all, each has sqrt(agreement) in the mean.
    """
    rows = structure.reshape(len(structure), -1).astype(np.float64)
    with_others = (rows @ rows.sum(axis=0) - (rows**2).sum(axis=1)) / (len(rows) - 1)
    return with_others / np.sqrt(max(agreement(structure), 1e-4))


def _two_means(rows: np.ndarray, generator: np.random.Generator) -> tuple[np.ndarray, float]:
    """The plane halfway between two means: its normal, and its distance along it."""
    mean = rows.mean(axis=0)
    directions = np.linalg.svd(rows - mean, full_matrices=False)[2][:_COMPONENTS]
    reduced = (rows - mean) @ directions.T
    best, centres = np.inf, np.zeros((2, len(directions)))
    for _ in range(_STARTS):
        found = reduced[generator.choice(len(reduced), 2, replace=False)]
        for _ in range(_ROUNDS):
            second = _distance(reduced, found[1]) < _distance(reduced, found[0])
            if second.all() or not second.any():
                break
            found = np.stack([reduced[~second].mean(axis=0), reduced[second].mean(axis=0)])
        spread = float(np.minimum(_distance(reduced, found[0]), _distance(reduced, found[1])).sum())
        if spread < best:
            best, centres = spread, found
    along = (centres[1] - centres[0]) @ directions
    return along, float(along @ mean + (centres[1] ** 2 - centres[0] ** 2).sum() / 2)


def _distance(rows: np.ndarray, place: np.ndarray) -> np.ndarray:
    return ((rows - place) ** 2).sum(axis=1)
