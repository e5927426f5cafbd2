"""What one feature says of something else, linearly and on pictures it was not fitted on: ridge,
cross-validated.

Every row is predicted by a regression fitted on the other folds. Within these, the strength of the penalty is
chosen for each target by the leave-one-out error, which ridge has in closed form (Allen's PRESS). The penalty
is relative to the mean squared singular value and no dimension is rescaled, so a prediction does not change
when the whole feature is scaled, its dimensions are permuted, or it is rotated. Leaves out non-linear
predictors.
"""

import numpy as np

PENALTIES = tuple(10.0**power for power in range(-7, 3))


def held_out(x: np.ndarray, y: np.ndarray, *, folds: int = 5, seed: int = 0) -> np.ndarray:
    """Predictions of (N, T) targets from (N, D) features, each row by a fit that did not see it: (N, T).

    Args:
        x: features; constant ones predict the mean of the other folds.
        y: targets.
        folds: how many parts the rows are dealt into.
        seed: of the deal.
    """
    x, y = finite(x, "the features"), finite(y, "the targets")
    if len(x) != len(y):
        raise ValueError(f"{len(x)} rows of features but {len(y)} rows of targets: give one target per row")
    predicted = np.empty_like(y)
    for test in fold_of(len(x), folds, seed):
        train = np.ones(len(x), bool)
        train[test] = False
        predicted[test] = fit_predict(x[train], y[train], x[test])
    return predicted


def finite(values: np.ndarray, what: str) -> np.ndarray:
    """The rows as float64, or an error that says how many hold something that is no finite number."""
    values = np.asarray(values, np.float64)
    bad = int((~np.isfinite(values.reshape(len(values), -1)).all(axis=1)).sum()) if len(values) else 0
    if bad:
        raise ValueError(f"{what}: {bad} of {len(values)} rows are not finite: drop them or check the model")
    return values


def fold_of(n_rows: int, folds: int, seed: int) -> list[np.ndarray]:
    """Row numbers of each fold, dealt at random; the folds' sizes differ by one at most."""
    if not 2 <= folds <= n_rows // 2:
        raise ValueError(f"{n_rows} rows cannot be dealt into {folds} folds: use 2 to {n_rows // 2}")
    return np.array_split(np.random.default_rng(seed).permutation(n_rows), folds)


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


def _decomposed(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left singular vectors (N, R) of centred features, squared singular values (R,), and (D, R) what takes
    coefficients of the former to weights of the dimensions. From the smaller of the two Gram matrices, which
    is several times as fast as the decomposition of x; directions with less than 1e-11 of the strongest's
    power are dropped.
    """
    wide = x.shape[1] > len(x)
    power, vectors = np.linalg.eigh(x @ x.T if wide else x.T @ x)
    keep = power > 1e-11 * max(power[-1], 1e-300)
    power, vectors = power[keep], vectors[:, keep]
    if wide:
        return vectors, power, x.T @ (vectors / power)
    root = np.sqrt(power)
    return x @ (vectors / root), power, vectors / root


def r_squared(
    predicted: np.ndarray, y: np.ndarray, *, folds: int = 5, seed: int = 0, pooled: bool = False
) -> np.ndarray | float:
    """Share of the variance that held-out predictions explain; at most 1, best 1, about 0 for chance.

    The reference is the mean of the folds that each prediction was fitted on, so that knowing nothing gives
    0; a fit that does harm is negative.

    Args:
        predicted: (N, T) from ``held_out`` with the same ``folds`` and ``seed``.
        y: (N, T).
        folds, seed: as given to ``held_out``.
        pooled: one number for all targets together, those that vary more weighing more; else (T,).
    """
    reference = np.empty_like(y, dtype=np.float64)
    for test in fold_of(len(y), folds, seed):
        train = np.ones(len(y), bool)
        train[test] = False
        reference[test] = y[train].mean(axis=0)
    left = np.square(predicted - y).sum(axis=0)
    spread = np.square(reference - y).sum(axis=0)
    if pooled:
        left, spread = left.sum(), spread.sum()
    share = 1 - left / np.where(spread > 0, spread, np.nan)
    return float(share) if pooled else share
