"""Parts by factor of what separates a cluster and of the distance of two images: exact, without a probe.

Features of factors stand side by side. Their squared distance is the sum of the squared distances of each
factor, their cosine the sum of each factor's part of the inner product: nothing is approximated. The parts
depend on the features' scale, as the clustering itself does; ``ratio`` does not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Features = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class ClusterShares:
    """C clusters, of some sizes, each against all other rows, by F factors, (C, F) each.

    ``share`` is the part of the squared distance between the means of cluster and rest, 0..1, and sums to 1
    over factors. ``ratio`` is the share of the factor's own variance that lies between cluster and rest (eta
    squared), 0..1, whatever the factor's scale. ``chance`` is the mean ratio for rows shuffled.
    """

    names: tuple[str, ...]
    factors: tuple[str, ...]
    sizes: np.ndarray
    share: np.ndarray
    ratio: np.ndarray
    chance: np.ndarray


@dataclass(frozen=True, eq=False)
class PairParts:
    """Parts of the distance and the cosine of two images, (F,) by factor.

    The squared ``distance`` and the ``cosine`` add up to those of the whole features, ``distance_share`` to 1
    (0 for identical features). ``own_cosine`` is of each factor alone, -1..1, NaN where a feature is 0.
    ``quantile`` is the share of all pairs of images that lie farther apart in this factor, near 1 where the
    two are unusually alike.
    """

    factors: tuple[str, ...]
    distance: np.ndarray
    distance_share: np.ndarray
    cosine: np.ndarray
    own_cosine: np.ndarray
    quantile: np.ndarray

    @property
    def most_alike(self) -> str:
        """The factor in which the pair is closest compared with other pairs."""
        return self.factors[int(self.quantile.argmax())]


def cluster_shares(
    features: Features, clusters: np.ndarray, *, permutations: int = 20, seed: int = 0
) -> ClusterShares:
    """The share of each factor, (N, D_f) by name, in separating each of two clusters or more from the rest.

    ``clusters`` are (N,) names or numbers; ``permutations`` of the rows give the chance level.
    """
    names = np.unique(clusters)
    if len(names) < 2:
        raise ValueError(
            f"a cluster needs others to compare with: {len(clusters)} rows form {len(names)} cluster"
        )
    member, count = np.asarray(clusters)[:, None] == names, len(clusters)  # (N, C)
    sizes = member.sum(axis=0)
    centred = [np.asarray(v, np.float64) - np.asarray(v, np.float64).mean(axis=0) for v in features.values()]
    total = np.array([(values**2).sum() for values in centred])

    def between(member: np.ndarray) -> np.ndarray:
        """Sum of squares between each cluster and the rest, by factor: (C, F)."""
        means = [member.T.astype(np.float64) @ values / sizes[:, None] for values in centred]
        apart = np.stack([(values**2).sum(axis=1) for values in means], axis=1)  # |mean of the cluster|^2
        return apart * (sizes * count / (count - sizes))[:, None]

    generator, found = np.random.default_rng(seed), between(member)
    shuffled = [between(generator.permutation(member)) for _ in range(permutations)]
    distance = found / (sizes * (count - sizes) / count)[:, None]
    return ClusterShares(
        tuple(map(str, names)),
        tuple(features),
        sizes,
        _over(distance, distance.sum(axis=1, keepdims=True)),
        _over(found, total),
        _over(np.mean(shuffled, axis=0), total),
    )


def pair_parts(
    features: Features, first: int, second: int, *, pairs: int = 2_000, seed: int = 0
) -> PairParts:
    """Parts of distance and cosine of two of N rows, by factor, (N, D_f); place among random ``pairs``."""
    rows = [np.asarray(values, np.float64) for values in features.values()]
    generator, count = np.random.default_rng(seed), len(rows[0])
    one = generator.integers(count, size=pairs)
    other = (one + generator.integers(1, max(count, 2), size=pairs)) % count

    def apart(one: Sequence[int] | np.ndarray, other: Sequence[int] | np.ndarray) -> np.ndarray:
        return np.stack([((v[one] - v[other]) ** 2).sum(axis=1) for v in rows])  # (F, pairs)

    distance = apart([first], [second])
    inner = np.array([v[first] @ v[second] for v in rows])
    lengths = np.array([np.linalg.norm(v[[first, second]], axis=1) for v in rows])  # (F, 2)
    own, whole = lengths.prod(axis=1), np.linalg.norm(lengths, axis=0).prod()
    return PairParts(
        tuple(features),
        distance[:, 0],
        _over(distance[:, 0], distance.sum()),
        _over(inner, whole),
        np.divide(inner, own, out=np.full(len(rows), np.nan), where=own > 0),
        (apart(one, other) > distance).mean(axis=1),
    )


def _over(part: np.ndarray, whole: np.ndarray | float) -> np.ndarray:
    return np.divide(part, whole, out=np.zeros_like(part), where=np.asarray(whole) > 0)
