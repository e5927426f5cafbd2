"""Pearson's correlation between features, in both readings of the paper's one sentence.

Source: Klinghoffer et al., ECCV 2022, Sec. 5: "Pearson's correlation coefficient between each combination of
the four learned physical features", 0.26 to 0.28 without LOOCC and 0.18 with it. The paper does not say over
what the coefficient is taken, so both readings stand here, each under its own name. For features A and B of N
pictures, a_i and b_i being the feature vectors of picture i and a_p, b_q single dimensions over the N
pictures:

    per image       r(A, B) = 1/N sum_i corr(a_i, b_i), signed; it needs vectors of one length, and it depends
                    on the order of the dimensions, which in a learned code means nothing
    per dimension   r(A, B) = mean over all pairs (p, q) of |corr(a_p, b_q)|; of rows dealt at random it is
                    not 0 but about sqrt(2 / (pi (N - 1)))

Either is then averaged over the pairs of different features. A constant vector or dimension (a unit that
never fires) has no correlation; it is left out and counted. Neither number proves disentanglement: an
untrained encoder has about 0.07 in the second reading. Read them with swap.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from derender.evaluation.disentanglement.ridge import finite


@dataclass(frozen=True)
class PearsonScores:
    """Correlations between F features.

    Attributes:
        per_image: (F, F) mean over pictures of the correlation between two vectors, -1..1, best 0; NaN where
            the two have different lengths. The diagonal is 1.
        per_dimension: (F, F) mean absolute correlation over pairs of dimensions, 0..1, best 0; on the
            diagonal between different dimensions of one feature.
        mean_per_image, mean_per_dimension: over the pairs of different features: the two candidates for the
            paper's number.
        n_dead: by feature, dimensions that are the same in every picture; left out.
    """

    per_image: np.ndarray
    per_dimension: np.ndarray
    mean_per_image: float
    mean_per_dimension: float
    n_dead: dict[str, int]


def pearson(factors: Mapping[str, np.ndarray]) -> PearsonScores:
    """Both readings for features by name, each (N, D) with the same N of 3 or more."""
    blocks = _checked(factors)
    names = list(blocks)
    unit = {name: _standardised(values) for name, values in blocks.items()}
    alive = {name: values.any(axis=0) for name, values in unit.items()}
    image, dimension = (np.full((len(names), len(names)), np.nan) for _ in range(2))
    for i, a in enumerate(names):
        for j, b in enumerate(names):
            if blocks[a].shape == blocks[b].shape:
                image[i, j] = _mean(per_image(blocks[a], blocks[b]))
            r = np.abs(unit[a][:, alive[a]].T @ unit[b][:, alive[b]])
            dimension[i, j] = _mean(r[~np.eye(len(r), dtype=bool)] if i == j else r)
    pairs = ~np.eye(len(names), dtype=bool)
    return PearsonScores(
        image,
        dimension,
        mean_per_image=_mean(image[pairs]),
        mean_per_dimension=_mean(dimension[pairs]),
        n_dead={name: int((~alive[name]).sum()) for name in names},
    )


def per_image(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) correlation between the two vectors (N, D) of each picture, -1..1; NaN where one is constant."""
    if a.shape != b.shape:
        raise ValueError(f"the per-image reading needs vectors of one length, got {a.shape} and {b.shape}")
    a, b = (_standardised(np.asarray(values, np.float64).T) for values in (a, b))
    defined = a.any(axis=0) & b.any(axis=0)
    return np.where(defined, (a * b).sum(axis=0), np.nan)


def correlation_matrix(factors: Mapping[str, np.ndarray]) -> np.ndarray:
    """|correlation| between all dimensions of all features over pictures, (sum of D, sum of D), 0..1.

    What the per-dimension reading averages, as a whole; dead dimensions have NaN.
    """
    values = _standardised(np.concatenate(list(_checked(factors).values()), axis=1))
    alive = np.asarray(values.any(axis=0))
    return np.where(alive[:, None] & alive, np.abs(values.T @ values), np.nan)


def _checked(factors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    blocks = {name: finite(values, f"feature {name!r}") for name, values in factors.items()}
    lengths = {len(values) for values in blocks.values()}
    if len(blocks) < 2:
        raise ValueError("a correlation between features needs two features or more")
    if len(lengths) != 1 or min(lengths) < 3:
        raise ValueError(f"features must have one number of rows, 3 or more; there are {sorted(lengths)}")
    return blocks


def _standardised(values: np.ndarray) -> np.ndarray:
    """Columns with mean 0 and length 1; zero where a column is constant."""
    centred = values - values.mean(axis=0)
    length = np.linalg.norm(centred, axis=0)
    level = np.abs(values).max(axis=0, initial=0)
    constant = np.asarray(length <= 1e-9 * np.sqrt(len(values)) * level)
    return np.where(constant, 0.0, centred / np.where(constant, 1.0, length))


def _mean(values: np.ndarray) -> float:
    """Mean over what is defined; NaN where nothing is."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else float("nan")
