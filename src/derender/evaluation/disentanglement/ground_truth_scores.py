"""Which feature holds which true factor: R2, DCI, MIG and SAP, of whole features and of single dimensions.

Source: DCI: Eastwood and Williams, ICLR 2018; MIG: Chen et al., NeurIPS 2018; SAP: Kumar et al., ICLR 2018;
the weighting of DCI and 20 bins for MIG as in Locatello et al., ICML 2019.

These scores were made for codes of ten dimensions, each meant to hold one factor. Here a factor is meant to
be held by one of four features of 256 dimensions, in any basis. So each score stands twice:

    by feature    a feature counts for what it predicts on pictures that the predictor has not seen
                  (ridge.py): R2 of a number; of a class, accuracy above that of the largest class, over what
                  is left to gain. Blind to scale, order of dimensions and rotations inside a feature. The
                  score to read.
    by dimension  as published: dimensions compete with each other, so a factor spread over two dimensions of
        the
                  right feature costs as much as one held twice by different features.

All are 0..1 and best at 1; features that tell nothing score about 0. None asks whether the right feature
holds a factor; ``placed`` does.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from derender.evaluation.disentanglement.importance import importance
from derender.evaluation.disentanglement.ridge import finite, held_out, r_squared
from derender.evaluation.disentanglement.true_factors import TrueFactor

BINS = 20


@dataclass(frozen=True)
class ModularityScores:
    """DCI, MIG and SAP; each 0..1, best 1.

    Attributes:
        disentanglement: each feature (or dimension) matters for one factor only.
        completeness: each factor matters in one feature only.
        informativeness: how well all features together predict the factors, mean over factors.
        mig: gap of mutual information between the best and the second best, over the factor's entropy.
        sap: gap of predictive score between the best and the second best.
    """

    disentanglement: float
    completeness: float
    informativeness: float
    mig: float
    sap: float


@dataclass(frozen=True)
class GroundTruthScores:
    """F features against K true factors.

    Attributes:
        features, factors: names of the rows and columns.
        score: (F, K) held-out R2 of numbers, at most 1 and negative where the fit does harm; accuracy of
            classes, 0..1. Best 1.
        together: (K,) the same of all features side by side.
        chance: (K,) what knowing nothing gives: 0 for numbers, the largest class's share for classes.
        by_feature: scores of whole features.
        by_dimension: scores of single dimensions; None where they were not asked for.
        grouped_dci: disentanglement and completeness of the dimensions' importances added up by feature: DCI
            as published, at the level of features; None where ``by_dimension`` is.
        placed: share of the factors that the right feature predicts best, 0..1, best 1; NaN where none of
            the features has a factor of its own.
    """

    features: tuple[str, ...]
    factors: tuple[str, ...]
    score: np.ndarray
    together: np.ndarray
    chance: np.ndarray
    by_feature: ModularityScores
    by_dimension: ModularityScores | None
    grouped_dci: tuple[float, float] | None
    placed: float


def ground_truth_scores(
    blocks: Mapping[str, np.ndarray],
    factors: list[TrueFactor],
    *,
    dimensions: str | None = None,
    folds: int = 5,
    seed: int = 0,
) -> GroundTruthScores:
    """All scores of features by name, each (N, D), against true factors of the same N pictures.

    Args:
        blocks: features.
        factors: at least two.
        dimensions: how single dimensions are weighed for their DCI ("lasso", fast, or "trees", slow); None
            leaves the scores by dimension out.
        folds: of the predictions.
        seed: of the deal into folds, and of the trees.
    """
    if len(factors) < 2 or len(blocks) < 2:
        raise ValueError(f"needs two features and two true factors, got {len(blocks)} and {len(factors)}")
    blocks = {name: finite(values, f"feature {name!r}") for name, values in blocks.items()}
    everything = np.concatenate(list(blocks.values()), axis=1)
    found = [_predicted(x, factors, folds, seed) for x in (*blocks.values(), everything)]
    raw = np.array([[score for score, _, _ in row] for row in found])
    gain = np.array([[gain for _, gain, _ in row] for row in found])
    share, together = gain[:-1], gain[-1]
    gaps = [
        _information_gap(np.stack([found[i][k][2] for i in range(len(blocks))], axis=1), factor)
        for k, factor in enumerate(factors)
    ]
    names = tuple(blocks)
    owned = [(k, f) for k, f in enumerate(factors) if set(f.belongs_to) & set(names)]
    right = [
        names[int(share[:, k].argmax())] in f.belongs_to for k, f in owned if share[:, k].max(initial=0) > 0
    ]
    informativeness = float(together.mean())
    dimension, grouped = None, None
    if dimensions is not None:
        weights = importance(everything, factors, dimensions, seed=seed)
        dimension = _by_dimension(everything, factors, weights, informativeness)
        grouped = dci(_grouped(weights, blocks))
    return GroundTruthScores(
        names,
        tuple(f.name for f in factors),
        score=raw[:-1],
        together=raw[-1],
        chance=np.array([_largest_share(f) for f in factors]),
        by_feature=ModularityScores(
            *dci(share), informativeness, mig=float(np.mean(gaps)), sap=float(np.mean(_gap(share)))
        ),
        by_dimension=dimension,
        grouped_dci=grouped,
        placed=sum(right) / len(owned) if owned else float("nan"),
    )


def dci(weights: np.ndarray) -> tuple[float, float]:
    """Disentanglement and completeness of (D, K) non-negative importances, each 0..1, best 1.

    One minus the entropy, in units of the largest possible, of each row (column), weighted by the row's
    (column's) share of all importance. No importance at all scores 0 in both.
    """
    weights = np.asarray(weights, np.float64)
    if weights.ndim != 2 or min(weights.shape) < 2 or not (np.isfinite(weights) & (weights >= 0)).all():
        raise ValueError(
            f"DCI needs importances of 0 and up, two rows and columns or more, got shape {weights.shape}"
        )
    if weights.sum() == 0:
        return 0.0, 0.0
    return _concentration(weights), _concentration(weights.T)


def mutual_information(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mutual information in nats between each column of (N, D) integers and (N,) integers: (D,)."""
    table = np.zeros((a.shape[1], int(a.max()) + 1, int(b.max()) + 1))
    np.add.at(table, (np.arange(a.shape[1]), a, b[:, None]), 1 / len(b))
    product = table.sum(axis=2, keepdims=True) * table.sum(axis=1, keepdims=True)
    full = table > 0
    return np.where(full, table * np.log(np.where(full, table, 1) / np.where(full, product, 1)), 0).sum(
        axis=(1, 2)
    )


def binned(values: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Columns of (N, D) numbers as integers 0..bins-1, bins of equal width between each column's ends."""
    low, high = values.min(axis=0), values.max(axis=0)
    width = np.where(high > low, high - low, 1)
    return np.clip(((values - low) / width * bins).astype(np.int64), 0, bins - 1)


def _predicted(
    x: np.ndarray, factors: list[TrueFactor], folds: int, seed: int
) -> list[tuple[float, float, np.ndarray]]:
    """For each factor: score, score above chance in 0..1, and the (N,) binned prediction from one feature."""
    targets = [factor.targets() for factor in factors]
    answers = held_out(x, np.concatenate(targets, axis=1), folds=folds, seed=seed)
    ends = np.cumsum([target.shape[1] for target in targets])
    found = []
    for factor, target, end in zip(factors, targets, ends, strict=True):
        predicted = answers[:, end - target.shape[1] : end]
        if factor.is_class:
            answer = predicted.argmax(axis=1)
            accuracy, largest = float((answer == factor.values).mean()), _largest_share(factor)
            found.append((accuracy, max(0.0, (accuracy - largest) / (1 - largest)), answer))
        else:
            share = float(np.asarray(r_squared(predicted, target, folds=folds, seed=seed))[0])
            found.append((share, max(0.0, share), binned(predicted)[:, 0]))
    return found


def _by_dimension(
    codes: np.ndarray, factors: list[TrueFactor], weights: np.ndarray, informativeness: float
) -> ModularityScores:
    bins = binned(codes)
    return ModularityScores(
        *dci(weights),
        informativeness,
        mig=float(np.mean([_information_gap(bins, factor) for factor in factors])),
        sap=float(np.mean(_gap(np.stack([_single(codes, factor) for factor in factors], axis=1)))),
    )


def _grouped(weights: np.ndarray, blocks: Mapping[str, np.ndarray]) -> np.ndarray:
    """Importances of dimensions (D, K) added up by feature: (F, K)."""
    starts = np.cumsum([0, *(values.shape[1] for values in blocks.values())])[:-1]
    return np.add.reduceat(weights, starts, axis=0)


def _single(codes: np.ndarray, factor: TrueFactor) -> np.ndarray:
    """(D,) share of a dimension's variance that goes with the factor: squared correlation with a number, with
    classes the squared correlation ratio (SAP as published has an SVM's accuracy there).
    """
    centred = codes - codes.mean(axis=0)
    total = np.square(centred).sum(axis=0)
    targets = factor.targets()
    if factor.is_class:
        sums, sizes = targets.T @ centred, targets.sum(axis=0)
        explained = (np.square(sums) / np.maximum(sizes, 1)[:, None]).sum(axis=0)
    else:
        true = targets[:, 0] - targets.mean()
        explained = np.square(true @ centred) / np.square(true).sum()
    alive = total > 1e-18 * np.square(codes).sum(axis=0)
    return np.where(alive, explained / np.where(alive, total, 1), 0)


def _information_gap(bins: np.ndarray, factor: TrueFactor) -> float:
    """MIG of one factor: from (N, D) integers, in units of the factor's entropy."""
    true = factor.values if factor.is_class else binned(factor.values[:, None])[:, 0]
    entropy = mutual_information(true[:, None], true)[0]
    return float(_gap(mutual_information(bins, true)[:, None])[0] / entropy)


def _gap(scores: np.ndarray) -> np.ndarray:
    """Best minus second best of each column of (D, K)."""
    ordered = np.sort(scores, axis=0)
    return ordered[-1] - ordered[-2]


def _concentration(weights: np.ndarray) -> float:
    total = weights.sum(axis=1, keepdims=True)
    share = weights / np.where(total > 0, total, 1)
    entropy = -(share * np.log(np.where(share > 0, share, 1))).sum(axis=1) / np.log(weights.shape[1])
    return float(((1 - entropy) * total[:, 0]).sum() / total.sum())


def _largest_share(factor: TrueFactor) -> float:
    return float(np.bincount(factor.values).max() / len(factor.values)) if factor.is_class else 0.0
