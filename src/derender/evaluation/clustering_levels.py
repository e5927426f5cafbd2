"""FINCH's whole hierarchy scored level by level: no number of clusters is given to it.

Purity and NMI grow with the number of clusters, so levels of different features are not comparable by these
alone; ARI and the number of clusters beside the number of classes are.
"""

from dataclasses import dataclass

import numpy as np

from derender.evaluation.clustering_methods import finch_hierarchy
from derender.evaluation.clustering_scores import ClusterScores, chance_scores, cluster_scores
from derender.evaluation.memory import Memory
from derender.features import missing


@dataclass(frozen=True)
class Level:
    """One partition of a hierarchy.

    Attributes:
        clusters: their number.
        scores: of the rows that carry a label.
        chance: the same cluster sizes, rows dealt at random.
    """

    clusters: int
    scores: ClusterScores
    chance: ClusterScores


def finch_levels(features: np.ndarray, labels: np.ndarray, memory: Memory | None = None) -> tuple[Level, ...]:
    """Every partition that FINCH finds in (N, D) features, from fine to coarse, against (N,) labels.

    Rows without label are left out before.
    """
    labels = np.asarray(labels)
    known = ~missing(labels)
    hierarchy = finch_hierarchy(np.asarray(features)[known], memory)
    return tuple(
        Level(count, cluster_scores(labels[known], partition), chance_scores(labels[known], partition)[0])
        for count, partition in zip(hierarchy.counts, hierarchy.partitions, strict=True)
    )
