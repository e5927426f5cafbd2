"""How much single dimensions of a code matter for a true factor, as DCI was published: lasso or boosted
trees.

Source: Eastwood and Williams, ICLR 2018 (absolute weights of a lasso on standardised codes); Locatello et
al., ICML 2019 (importances of gradient boosted trees). A class is regressed as one lasso for each class, the
weights added up; boosted trees take classes as they are. Neither is blind to a rotation of the code: the
block scores of ground_truth_scores.py are.
"""

from typing import Any

import numpy as np

from derender.evaluation.disentanglement.true_factors import TrueFactor

METHODS = ("lasso", "trees")
PENALTIES = (0.5, 0.2, 0.1)  # a warm path to the last; as shares of the smallest one that leaves no weight
TOLERANCE = 1e-2  # of the duality gap, in units of the target's power


def importance(codes: np.ndarray, factors: list[TrueFactor], method: str, *, seed: int = 0) -> np.ndarray:
    """(D, K) importance of each dimension of (N, D) codes for each of K factors; 0 and up, each column adds
    to 1.

    A column is 0 throughout where no dimension helps. ``seed`` matters to trees only. The lasso's penalty is
    a fixed share of the largest useful one, so the result does not change when codes or factors are scaled.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: choose lasso or trees")
    codes = np.asarray(codes, np.float64)
    spread = codes.std(axis=0)
    level = np.abs(codes).max(axis=0, initial=0)
    alive = spread > 1e-9 * level
    standard = (codes[:, alive] - codes[:, alive].mean(axis=0)) / spread[alive]
    found = np.zeros((codes.shape[1], len(factors)))
    for column, factor in enumerate(factors):
        if alive.any():
            measure = _lasso if method == "lasso" else _trees
            found[alive, column] = measure(standard, factor, seed)
    total = found.sum(axis=0)
    return found / np.where(total > 0, total, 1)


def _lasso(codes: np.ndarray, factor: TrueFactor, seed: int) -> np.ndarray:
    """Sum over the factor's targets of absolute lasso weights, by cyclic coordinate descent."""
    from sklearn.linear_model import lasso_path

    how: dict[str, Any] = {"alphas": PENALTIES, "tol": TOLERANCE, "max_iter": 5000}
    targets = factor.targets()
    targets = targets - targets.mean(axis=0)
    gram, weights = codes.T @ codes, np.zeros(codes.shape[1])
    for target in targets.T:
        along = codes.T @ target
        largest = np.abs(along).max() / len(codes)
        if largest > 0:
            how |= {"precompute": gram, "Xy": along / largest}
            weights += np.abs(lasso_path(codes, target / largest, **how)[1][:, -1]) * largest
    return weights


def _trees(codes: np.ndarray, factor: TrueFactor, seed: int) -> np.ndarray:
    from sklearn.ensemble import GradientBoostingClassifier, GradientBoostingRegressor

    kind = GradientBoostingClassifier if factor.is_class else GradientBoostingRegressor
    return np.asarray(kind(random_state=seed).fit(codes, factor.values).feature_importances_)
