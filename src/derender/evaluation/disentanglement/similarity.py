"""How much two features share: Pearson's correlation, linear CKA and cross-prediction. All are best at 0.

Pearson: Klinghoffer et al., ECCV 2022, Sec. 5, in both readings that the paper allows. *Per image* is the
mean over images of the signed correlation of two features' vectors. It needs vectors of one length and
depends on the order of dimensions. *Per dimension* is the mean over pairs of dimensions of |correlation| over
the N images. Shuffled rows score about sqrt(2 / (pi (N - 1))).

CKA: Kornblith et al., ICML 2019; unbiased with the HSIC estimator of Song et al., JMLR 2012. The biased form
is far from 0 for independent features of many dimensions. Cross-prediction: ridge regression from one feature
to another, held out; every target gets its own penalty by generalised cross-validation. No low number proves
disentanglement: read them beside the swap test (swap.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from derender.features.table import check_finite

PENALTIES = tuple(10.0**power for power in range(-7, 3))
CAUTION = 1.1  # what a degree of freedom counts; at 1 it is too little where there are as many as rows


@dataclass(frozen=True)
class PearsonScores:
    """Correlations between F features, (F, F) each, and their means over pairs of different features, best 0.

    ``per_image`` is NaN for different lengths. ``n_dead`` dimensions, by feature, are the same in every image
    and left out.
    """

    per_image: np.ndarray
    per_dimension: np.ndarray
    mean_per_image: float
    mean_per_dimension: float
    n_dead: dict[str, int]


@dataclass(frozen=True)
class SimilarityScores:
    """Similarity of F features, (F, F) each, and means over the pairs of different features, best 0.

    ``cross_r2`` is the held-out share of the variance of the column's feature that the row's explains.
    """

    cka_biased: np.ndarray
    cka_unbiased: np.ndarray
    cross_r2: np.ndarray
    mean_cka_biased: float
    mean_cka_unbiased: float
    mean_cross_r2: float


def pearson(features: Mapping[str, np.ndarray]) -> PearsonScores:
    """Both readings for features by name, each (N, D) with the same N of 4 or more."""
    blocks = side_by_side(features)
    vectors = [_standardised(values.T) for values in blocks.values()]
    every, ends = correlation_matrix(features), np.cumsum([len(each) for each in vectors])[:-1]
    image, dimension = np.full((2, len(blocks), len(blocks)), np.nan)
    for i, row in enumerate(np.split(every, ends)):
        for j, block in enumerate(np.split(row, ends, axis=1)):
            dimension[i, j] = _mean(block[~np.eye(len(block), dtype=bool)] if i == j else block)
            a, b = vectors[i], vectors[j]
            if a.shape == b.shape:
                image[i, j] = _mean(np.where(a.any(axis=0) & b.any(axis=0), (a * b).sum(axis=0), np.nan))
    dead = [int(part.sum()) for part in np.split(np.isnan(every.diagonal()), ends)]
    means = _mean_of_pairs(image), _mean_of_pairs(dimension)
    return PearsonScores(image, dimension, *means, dict(zip(blocks, dead, strict=True)))


def correlation_matrix(features: Mapping[str, np.ndarray]) -> np.ndarray:
    """|correlation| between all dimensions of all features, (sum of D, sum of D), 0..1; NaN for dead ones."""
    values = _standardised(np.concatenate(list(side_by_side(features).values()), axis=1))
    alive = np.asarray(values.any(axis=0))
    return np.where(alive[:, None] & alive, np.abs(values.T @ values), np.nan)


def similarity(features: Mapping[str, np.ndarray], *, seed: int = 0) -> SimilarityScores:
    """Both forms of CKA, and cross-prediction in random folds, between features by name, each (N, D)."""
    blocks = list(side_by_side(features).values())
    biased, unbiased, cross = np.full((3, len(blocks), len(blocks)), np.nan)
    every, ends = np.concatenate(blocks, axis=1), np.cumsum([values.shape[1] for values in blocks])[:-1]
    for i, a in enumerate(blocks):
        squares = np.square(every - held_out(a, every, seed=seed)).sum(axis=1)
        left, total = (np.split(each, ends) for each in squares)
        for j, b in enumerate(blocks):
            cross[i, j] = 1 - left[j].sum() / (total[j].sum() or np.nan)
            if j <= i:
                biased[i, j] = biased[j, i] = linear_cka(a, b, unbiased=False)
                unbiased[i, j] = unbiased[j, i] = linear_cka(a, b, unbiased=True)
    return SimilarityScores(biased, unbiased, cross, *map(_mean_of_pairs, (biased, unbiased, cross)))


def linear_cka(x: np.ndarray, y: np.ndarray, *, unbiased: bool) -> float:
    """Linear CKA of features (N, D) and (N, E) of the same 4 images or more.

    1 for features equal up to rotation and scale; independent ones score 0 on average if ``unbiased``. NaN
    where one of the two is the same in every image.
    """
    x, y = _centred(x), _centred(y)
    hsic = _unbiased_hsic if unbiased else lambda x, y: float(np.square(x.T @ y).sum())
    own = hsic(x, x) * hsic(y, y)
    return float(hsic(x, y) / np.sqrt(own)) if own > 0 else float("nan")


def held_out(x: np.ndarray, y: np.ndarray, *, folds: int = 5, seed: int = 0) -> np.ndarray:
    """Predictions of (N, T) targets, each row by a fit without it: (2, N, T).

    Those of a ridge regression from (N, D) features, and the means that a fit without features predicts: the
    reference of R2, which a constant feature reaches exactly. ``seed`` deals the rows into ``folds``.
    """
    if not 2 <= folds <= len(x) // 2:
        raise ValueError(f"{len(x)} rows cannot be dealt into {folds} folds: use 2 to {len(x) // 2}")
    predicted = np.empty((2, *y.shape))
    for test in np.array_split(np.random.default_rng(seed).permutation(len(x)), folds):
        train = np.ones(len(x), bool)
        train[test] = False
        predicted[0, test] = fit_predict(x[train], y[train], x[test])
        predicted[1, test] = y[train].mean(axis=0)
    return predicted


def fit_predict(x: np.ndarray, y: np.ndarray, x_new: np.ndarray) -> np.ndarray:
    """Ridge with an intercept from (N, D) to (N, T), applied to (M, D): (M, T) predictions.

    ``PENALTIES`` are relative to the mean squared singular value of the centred features that is not 0. Each
    target gets its own one by generalised cross-validation (Golub et al., Technometrics 1979).
    """
    mean, centre = y.mean(axis=0), x.mean(axis=0)
    apart, centred = y - mean, x - centre
    wide = x.shape[1] > len(x)
    power, vectors = np.linalg.eigh(centred @ centred.T if wide else centred.T @ centred)
    alive = power > 1e-11 * max(power[-1], 1e-300)
    if not alive.any():
        return np.tile(mean, (len(x_new), 1))
    power, vectors = power[alive], vectors[:, alive]
    left = vectors if wide else centred @ vectors / np.sqrt(power)
    along = left.T @ apart
    penalties = np.array(PENALTIES)[:, None] * power.mean()
    shrunk = penalties / (power + penalties)  # (penalties, directions): shares of ``along`` that are left
    unseen = np.maximum(1 - CAUTION * (1 + (1 - shrunk).sum(axis=1)) / len(x), 1e-99)  # none: never chosen
    rest = np.square(apart).sum(axis=0) - np.square(along).sum(axis=0)
    errors = (np.square(shrunk) @ np.square(along) + rest) / np.square(unseen)[:, None]
    kept = 1 - shrunk[np.argmin(errors, axis=0)].T
    return mean + ((x_new - centre) @ centred.T @ left) @ (kept * along / power[:, None])


def side_by_side(features: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Features as float64; ValueError unless there are two or more, of the same 4 rows or more, finite."""
    blocks = {name: np.asarray(values, np.float64) for name, values in features.items()}
    lengths = sorted({len(values) for values in blocks.values()})
    if len(blocks) < 2 or len(lengths) != 1 or lengths[0] < 4:
        needed = "scores between features need two or more of one number of rows, 4 or more"
        raise ValueError(f"{needed}; got {len(blocks)} features of {lengths} rows")
    check_finite(blocks, [f"row {row}" for row in range(lengths[0])])
    return blocks


def _centred(values: np.ndarray) -> np.ndarray:
    """Columns with mean 0; zero where a column is constant."""
    centred = values - values.mean(axis=0)
    level = np.abs(values).max(axis=0, initial=0)
    return np.where(np.abs(centred).max(axis=0, initial=0) <= 1e-9 * level, 0.0, centred)


def _standardised(values: np.ndarray) -> np.ndarray:
    """Columns with mean 0 and length 1; zero where a column is constant."""
    centred = _centred(values)
    length = np.linalg.norm(centred, axis=0)
    return centred / np.where(length > 0, length, 1)


def _unbiased_hsic(x: np.ndarray, y: np.ndarray) -> float:
    """Song et al.'s estimator without the N x N kernels K and L, whose diagonals it sets to 0."""
    n = len(x)
    k_diagonal, l_diagonal = np.square(x).sum(axis=1), np.square(y).sum(axis=1)
    k_rows, l_rows = x @ x.sum(axis=0) - k_diagonal, y @ y.sum(axis=0) - l_diagonal
    trace = np.square(x.T @ y).sum() - k_diagonal @ l_diagonal
    corrected = trace + k_rows.sum() * l_rows.sum() / ((n - 1) * (n - 2)) - 2 * (k_rows @ l_rows) / (n - 2)
    return float(corrected / (n * (n - 3)))


def _mean(values: np.ndarray) -> float:
    """Mean of all that is not NaN; NaN where nothing is."""
    return float(np.ma.filled(np.ma.masked_invalid(values).mean(), np.nan))


def _mean_of_pairs(matrix: np.ndarray) -> float:
    return _mean(matrix[~np.eye(len(matrix), dtype=bool)])
