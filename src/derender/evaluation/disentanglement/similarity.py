"""How much two features share: Pearson's correlation, linear CKA and cross-prediction. All are best at 0.

Sources. Pearson: Klinghoffer et al., ECCV 2022, Sec. 5: "Pearson's correlation coefficient between each
combination of the four learned physical features", 0.26 to 0.28 without LOOCC and 0.18 with it. The paper
does not define over which values it is taken, so both readings are here. For features A and B of N images,
a_i and b_i being the vectors of image i and a_p, b_q single dimensions over the N images:

    per image       r(A, B) = 1/N sum_i corr(a_i, b_i), signed; needs vectors of one length and depends on the
                    order of the dimensions, which has no meaning in a learned code
    per dimension   r(A, B) = mean over all pairs (p, q) of |corr(a_p, b_q)|; shuffled rows score not 0 but
                    about sqrt(2 / (pi (N - 1)))

CKA: Kornblith et al., ICML 2019; unbiased with the HSIC estimator of Song et al., JMLR 2012, as in Nguyen et
al., ICLR 2021. The biased form is far from 0 for independent features when there are more dimensions than a
small fraction of the rows (two features of 256 normal numbers on 800 images: 0.24). Cross-prediction: ridge
regression from one feature to another, scored on images it was not fitted on. Within each fold, every target
gets the penalty with the smallest leave-one-out error (Allen's PRESS, in closed form). Penalties are
relative to the mean squared singular value and no dimension is rescaled, so predictions do not change with
the scale of a feature, the order of its dimensions or a rotation.

No low number proves disentanglement: an untrained encoder has about 0.07 per dimension. Read them beside the
swap test (swap.py). Leaves out kernels other than the linear one and non-linear predictors.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

PENALTIES = tuple(10.0**power for power in range(-7, 3))


@dataclass(frozen=True)
class PearsonScores:
    """Correlations between F features.

    Attributes:
        per_image: (F, F) mean over images of the correlation between two vectors, -1..1, best 0; NaN where
            the two have different lengths. The diagonal is 1.
        per_dimension: (F, F) mean absolute correlation over pairs of dimensions, 0..1, best 0; on the
            diagonal between different dimensions of one feature.
        mean_per_image, mean_per_dimension: over the pairs of different features: the two candidates for the
            paper's number.
        n_dead: by feature, dimensions that are the same in every image; left out.
    """

    per_image: np.ndarray
    per_dimension: np.ndarray
    mean_per_image: float
    mean_per_dimension: float
    n_dead: dict[str, int]


@dataclass(frozen=True)
class SimilarityScores:
    """Similarity of F features; all best at 0 between different features.

    Attributes:
        cka_biased: (F, F) 0..1, 1 on the diagonal.
        cka_unbiased: (F, F) about 0 for independent features (it may fall a little below), 1 on the diagonal.
        cross_r2: (F, F) held-out share of the variance of the feature in the column that the feature in the
            row explains, at most 1; below 0 where the fit does harm.
        mean_cka_biased, mean_cka_unbiased, mean_cross_r2: over the pairs of different features.
    """

    cka_biased: np.ndarray
    cka_unbiased: np.ndarray
    cross_r2: np.ndarray
    mean_cka_biased: float
    mean_cka_unbiased: float
    mean_cross_r2: float


def pearson(factors: Mapping[str, np.ndarray]) -> PearsonScores:
    """Both readings for features by name, each (N, D) with the same N of 3 or more."""
    blocks = _same_rows(factors)
    unit = [_standardised(values) for values in blocks.values()]
    alive = [values.any(axis=0) for values in unit]
    image, dimension = np.full((2, len(blocks), len(blocks)), np.nan)
    for i, a in enumerate(blocks.values()):
        for j, b in enumerate(blocks.values()):
            if a.shape == b.shape:
                image[i, j] = _mean(per_image(a, b))
            r = np.abs(unit[i][:, alive[i]].T @ unit[j][:, alive[j]])
            dimension[i, j] = _mean(r[~np.eye(len(r), dtype=bool)] if i == j else r)
    dead = {name: int((~columns).sum()) for name, columns in zip(blocks, alive, strict=True)}
    return PearsonScores(image, dimension, _mean(image, pairs=True), _mean(dimension, pairs=True), dead)


def per_image(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) correlation between the two vectors (N, D) of each image, -1..1; NaN where one is constant."""
    if a.shape != b.shape:
        raise ValueError(f"the per-image reading needs vectors of one length, got {a.shape} and {b.shape}")
    a, b = (_standardised(np.asarray(values, np.float64).T) for values in (a, b))
    return np.where(a.any(axis=0) & b.any(axis=0), (a * b).sum(axis=0), np.nan)


def correlation_matrix(factors: Mapping[str, np.ndarray]) -> np.ndarray:
    """|correlation| between all dimensions of all features over images, (sum of D, sum of D), 0..1.

    The per-dimension reading averages it; dead dimensions have NaN.
    """
    values = _standardised(np.concatenate(list(_same_rows(factors).values()), axis=1))
    alive = np.asarray(values.any(axis=0))
    return np.where(alive[:, None] & alive, np.abs(values.T @ values), np.nan)


def linear_cka(x: np.ndarray, y: np.ndarray, *, unbiased: bool) -> float:
    """Linear CKA of two features (N, D) and (N, E); 1 for features equal up to rotation and scale.

    Args:
        x, y: features of the same N images, N of 4 or more.
        unbiased: whether independent features score 0 on average.

    Returns NaN where one of the two is the same in every image.
    """
    x, y = (_centred(finite(values, "a feature")) for values in (x, y))
    if len(x) != len(y) or len(x) < 4:
        raise ValueError(f"CKA needs features of the same 4 rows or more, got {len(x)} and {len(y)} rows")
    hsic = _unbiased_hsic if unbiased else _biased_hsic
    own = hsic(x, x) * hsic(y, y)
    return float(hsic(x, y) / np.sqrt(own)) if own > 0 else float("nan")


def similarity(factors: Mapping[str, np.ndarray], *, folds: int = 5, seed: int = 0) -> SimilarityScores:
    """Both forms of CKA and cross-prediction between features by name, each (N, D).

    Args:
        factors: features.
        folds: of the cross-prediction.
        seed: of the random folds.
    """
    blocks = [finite(values, f"feature {name!r}") for name, values in factors.items()]
    biased, unbiased, cross = np.full((3, len(blocks), len(blocks)), np.nan)
    everything = np.concatenate(blocks, axis=1)
    ends = np.cumsum([values.shape[1] for values in blocks])
    for i, a in enumerate(blocks):
        predicted = held_out(a, everything, folds=folds, seed=seed)
        for j, b in enumerate(blocks):
            if j <= i:
                biased[i, j] = biased[j, i] = linear_cka(a, b, unbiased=False)
                unbiased[i, j] = unbiased[j, i] = linear_cka(a, b, unbiased=True)
            part = slice(ends[j] - b.shape[1], ends[j])
            cross[i, j] = r_squared(predicted[:, part], b, folds=folds, seed=seed, pooled=True)
    means = (_mean(matrix, pairs=True) for matrix in (biased, unbiased, cross))
    return SimilarityScores(biased, unbiased, cross, *means)


def held_out(x: np.ndarray, y: np.ndarray, *, folds: int = 5, seed: int = 0) -> np.ndarray:
    """Ridge predictions of (N, T) targets from (N, D) features, each row by a fit without it: (N, T).

    Args:
        x: features; constant ones predict the mean of the other folds.
        y: targets.
        folds: number of random parts.
        seed: of the random folds.
    """
    x, y = finite(x, "the features"), finite(y, "the targets")
    if len(x) != len(y):
        raise ValueError(f"{len(x)} rows of features but {len(y)} rows of targets: give one target per row")
    predicted = np.empty_like(y)
    for train, test in _folds(len(x), folds, seed):
        predicted[test] = fit_predict(x[train], y[train], x[test])
    return predicted


def fit_predict(
    x: np.ndarray, y: np.ndarray, x_new: np.ndarray, penalties: tuple[float, ...] = PENALTIES
) -> np.ndarray:
    """Ridge with an intercept from (N, D) to (N, T), applied to (M, D): (M, T) predictions.

    ``penalties`` are relative to the mean squared singular value of the centred features; each target gets
    the one with the smallest leave-one-out error.
    """
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    u, power, back = _decomposed(x - x_mean)
    if len(power) == 0:
        return np.tile(y_mean, (len(x_new), 1))
    centred = y - y_mean
    projected = u.T @ centred
    square, full = np.square(u), np.square(centred).sum(axis=0)
    best, chosen = np.full(y.shape[1], np.inf), np.zeros_like(projected)
    for penalty in penalties:
        shrink = (power / (power + penalty * power.mean()))[:, None]
        leverage = square @ shrink + 1 / len(x)
        left = centred - u @ (shrink * projected)
        error = np.square(left / np.maximum(1 - leverage, 1e-9)).sum(axis=0)
        better = (error < best) & (full > 0)
        best = np.where(better, error, best)
        chosen = np.where(better, shrink * projected, chosen)
    return y_mean + (x_new - x_mean) @ (back @ chosen)


def r_squared(
    predicted: np.ndarray, y: np.ndarray, *, folds: int = 5, seed: int = 0, pooled: bool = False
) -> np.ndarray | float:
    """Share of the variance that held-out predictions explain; at most 1, best 1, about 0 for chance.

    The reference is the mean of the folds that each prediction was fitted on, so that a constant gives 0; a
    fit that does harm is negative.

    Args:
        predicted: (N, T) from ``held_out`` with the same ``folds`` and ``seed``.
        y: (N, T).
        folds, seed: as given to ``held_out``.
        pooled: one number for all targets together, weighted by their variance; else (T,).
    """
    reference = np.empty_like(y, dtype=np.float64)
    for train, test in _folds(len(y), folds, seed):
        reference[test] = y[train].mean(axis=0)
    left, total = (np.square(values - y).sum(axis=0) for values in (predicted, reference))
    if pooled:
        left, total = left.sum(), total.sum()
    share = 1 - left / np.where(total > 0, total, np.nan)
    return float(share) if pooled else share


def finite(values: np.ndarray, what: str) -> np.ndarray:
    """The rows as float64, or an error that counts the rows with NaN or infinity."""
    values = np.asarray(values, np.float64)
    bad = int((~np.isfinite(values.reshape(len(values), -1)).all(axis=1)).sum()) if len(values) else 0
    if bad:
        raise ValueError(f"{what}: {bad} of {len(values)} rows are not finite: drop them or check the model")
    return values


def _folds(n_rows: int, folds: int, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(N,) bool training rows and the numbers of the tested rows; sizes of folds differ by one at most."""
    if not 2 <= folds <= n_rows // 2:
        raise ValueError(f"{n_rows} rows cannot be dealt into {folds} folds: use 2 to {n_rows // 2}")
    for test in np.array_split(np.random.default_rng(seed).permutation(n_rows), folds):
        train = np.ones(n_rows, bool)
        train[test] = False
        yield train, test


def _decomposed(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left singular vectors (N, R), squared singular values (R,), and (D, R) from coefficients of the former
    to weights of the dimensions, of centred features. From the smaller Gram matrix, which is several times as
    fast as the decomposition of x; directions with less than 1e-11 of the strongest's power are dropped.
    """
    wide = x.shape[1] > len(x)
    power, vectors = np.linalg.eigh(x @ x.T if wide else x.T @ x)
    keep = power > 1e-11 * max(power[-1], 1e-300)
    power, vectors = power[keep], vectors[:, keep]
    if wide:
        return vectors, power, x.T @ (vectors / power)
    root = np.sqrt(power)
    return x @ (vectors / root), power, vectors / root


def _same_rows(factors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    blocks = {name: finite(values, f"feature {name!r}") for name, values in factors.items()}
    lengths = {len(values) for values in blocks.values()}
    if len(blocks) < 2:
        raise ValueError("a correlation between features needs two features or more")
    if len(lengths) != 1 or min(lengths) < 3:
        raise ValueError(f"features must have one number of rows, 3 or more; there are {sorted(lengths)}")
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


def _biased_hsic(x: np.ndarray, y: np.ndarray) -> float:
    """HSIC of linear kernels up to a factor that depends on N only."""
    return float(np.square(x.T @ y).sum())


def _unbiased_hsic(x: np.ndarray, y: np.ndarray) -> float:
    """Song et al.'s estimator without the N x N kernels K and L, whose diagonals it sets to 0."""
    n = len(x)
    k_diagonal, l_diagonal = np.square(x).sum(axis=1), np.square(y).sum(axis=1)
    k_rows, l_rows = x @ x.sum(axis=0) - k_diagonal, y @ y.sum(axis=0) - l_diagonal
    trace = np.square(x.T @ y).sum() - k_diagonal @ l_diagonal
    corrected = trace + k_rows.sum() * l_rows.sum() / ((n - 1) * (n - 2)) - 2 * (k_rows @ l_rows) / (n - 2)
    return float(corrected / (n * (n - 3)))


def _mean(values: np.ndarray, *, pairs: bool = False) -> float:
    """Mean of all that is not NaN, with ``pairs`` off the diagonal; NaN where nothing is."""
    chosen = values[~np.eye(len(values), dtype=bool)] if pairs else values
    defined = chosen[~np.isnan(chosen)]
    return float(defined.mean()) if defined.size else float("nan")
