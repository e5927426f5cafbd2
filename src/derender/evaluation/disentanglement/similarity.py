"""How much two features have in common beyond single dimensions: linear CKA and cross-prediction.

Source: CKA: Kornblith et al., ICML 2019; its unbiased form uses the estimator of HSIC by Song et al., JMLR
2012, as Nguyen et al., ICLR 2021 do. The plain (biased) form is far from 0 for independent features when
there are more dimensions than a small fraction of the rows (two features of 256 normal numbers on 800
pictures: 0.24), so both are named and the unbiased one is the one to read. Cross-prediction: how well a
linear model tells one feature from another on pictures it was not fitted on (ridge.py). Leaves out kernels
other than the linear one.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from derender.evaluation.disentanglement.ridge import finite, held_out, r_squared


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


def linear_cka(x: np.ndarray, y: np.ndarray, *, unbiased: bool) -> float:
    """Linear CKA of two features (N, D) and (N, E); 1 for features equal up to rotation and scale.

    Args:
        x, y: features of the same N pictures, N of 4 or more.
        unbiased: whether 0 is what independent features score on average.

    Returns NaN where one of the two is the same in every picture.
    """
    x, y = _centred(x), _centred(y)
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
        seed: of the deal into folds.
    """
    blocks = {name: finite(values, f"feature {name!r}") for name, values in factors.items()}
    names, count = list(blocks), len(blocks)
    biased, unbiased, cross = np.full((3, count, count), np.nan)
    for i, a in enumerate(names):
        for j, b in enumerate(names[: i + 1]):
            biased[i, j] = biased[j, i] = linear_cka(blocks[a], blocks[b], unbiased=False)
            unbiased[i, j] = unbiased[j, i] = linear_cka(blocks[a], blocks[b], unbiased=True)
    everything = np.concatenate(list(blocks.values()), axis=1)
    ends = np.cumsum([values.shape[1] for values in blocks.values()])
    for i, a in enumerate(names):
        predicted = held_out(blocks[a], everything, folds=folds, seed=seed)
        for j, b in enumerate(names):
            part = slice(ends[j] - blocks[b].shape[1], ends[j])
            cross[i, j] = r_squared(predicted[:, part], blocks[b], folds=folds, seed=seed, pooled=True)
    pairs = ~np.eye(count, dtype=bool)
    return SimilarityScores(biased, unbiased, cross, *(_mean(m[pairs]) for m in (biased, unbiased, cross)))


def _centred(values: np.ndarray) -> np.ndarray:
    values = finite(values, "a feature")
    centred = values - values.mean(axis=0)
    level = np.abs(values).max(axis=0, initial=0)
    return np.where(np.abs(centred).max(axis=0, initial=0) <= 1e-9 * level, 0.0, centred)


def _biased_hsic(x: np.ndarray, y: np.ndarray) -> float:
    """HSIC of linear kernels up to a factor that depends on N only."""
    return float(np.square(x.T @ y).sum())


def _unbiased_hsic(x: np.ndarray, y: np.ndarray) -> float:
    """Song et al.'s estimator for linear kernels, without forming the N x N kernels.

    K and L are the kernels with their diagonals set to 0.
    """
    n = len(x)
    k_diagonal, l_diagonal = np.square(x).sum(axis=1), np.square(y).sum(axis=1)
    k_rows, l_rows = x @ x.sum(axis=0) - k_diagonal, y @ y.sum(axis=0) - l_diagonal
    trace = np.square(x.T @ y).sum() - k_diagonal @ l_diagonal
    return float(
        (trace + k_rows.sum() * l_rows.sum() / ((n - 1) * (n - 2)) - 2 * (k_rows @ l_rows) / (n - 2))
        / (n * (n - 3))
    )


def _mean(values: np.ndarray) -> float:
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else float("nan")
