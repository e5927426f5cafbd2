"""Clustering beside the obvious way: one tree for forty attributes, and Ward without all distances in memory.

First it is shown that both ways find the same clusters, then CPU time is taken in one run. ``--trees`` says
how many of the forty trees of the obvious way are really built; fewer are scaled up, and the output says so.

    .venv/bin/python benchmarks/clustering.py --json clustering.json
    .venv/bin/python benchmarks/clustering.py --large 50000
"""

import importlib
import importlib.util
import json
import resource
import sys
import time

import numpy as np
from machine import parser, publish
from scipy.cluster.hierarchy import linkage
from sklearn.cluster import AgglomerativeClustering
from sklearn.metrics import adjusted_rand_score

from derender.evaluation.clustering_methods import cut, finch, ward_tree
from derender.evaluation.clustering_scores import cluster_scores

ATTRIBUTES = 40


def features_of(rows: int, dimensions: int) -> np.ndarray:
    """Rectified mixtures of 24 hidden numbers, and noise: of low rank and not normal, as codes are."""
    rng = np.random.default_rng(0)
    hidden = rng.normal(size=(rows, 24)) @ rng.normal(size=(24, dimensions)) * 0.3
    return np.maximum(hidden + 0.1 * rng.normal(size=(rows, dimensions)), 0)


def seconds(function, *arguments):
    """CPU seconds of this process, and the result."""
    start = time.process_time()
    result = function(*arguments)
    return time.process_time() - start, result


def forty_attributes(features: np.ndarray, trees: int) -> dict[str, float | int]:
    """One tree cut once and scored forty times, against a tree for each attribute."""
    labels = np.random.default_rng(1).random((ATTRIBUTES, len(features))) < 0.2

    def once() -> list[float]:
        clusters = cut(ward_tree(features), 2)
        return [cluster_scores(one, clusters).accuracy for one in labels]

    def each() -> list[float]:
        return [cluster_scores(one, cut(linkage(features, "ward"), 2)).accuracy for one in labels[:trees]]

    def each_of_ours() -> list[float]:
        return [cluster_scores(one, cut(ward_tree(features), 2)).accuracy for one in labels[:trees]]

    ours, result = seconds(once)
    obvious, expected = seconds(each)
    obvious_ours, same = seconds(each_of_ours)
    assert np.allclose(result[:trees], expected) and np.allclose(result[:trees], same), "different clusters"
    scale = ATTRIBUTES / trees
    return {
        "one_tree_s": ours,
        "tree_for_each_scipy_s": obvious * scale,
        "tree_for_each_s": obvious_ours * scale,
        "trees_built": trees,
        "ratio_to_scipy": obvious * scale / ours,
        "ratio": obvious_ours * scale / ours,
    }


def agreement(features: np.ndarray) -> dict[str, float]:
    """How far Ward in bounded memory, and FINCH, are from SciPy's Ward on the same rows."""
    ours, theirs = ward_tree(features), linkage(features, "ward")
    result = {"largest_relative_height_error": float(np.abs(ours[:, 2] / theirs[:, 2] - 1).max())}
    for count in (2, 10, 40, 100):
        result[f"ward_ari_{count}"] = float(adjusted_rand_score(cut(ours, count), cut(theirs, count)))
    for count, partition in zip(*(lambda h: (h.counts, h.partitions))(finch(features)), strict=True):
        result[f"finch_ari_{count}"] = float(adjusted_rand_score(partition, cut(theirs, count)))
    return result


def one_tree(features: np.ndarray) -> dict[str, float | str]:
    """CPU seconds of one tree: derender's, and those of the peers that are installed, heights compared."""
    expected = linkage(features, "ward")
    result: dict[str, float | str] = {"ours": seconds(ward_tree, features)[0]}
    result["SciPy"] = seconds(linkage, features, "ward")[0]
    result["scikit-learn"] = seconds(AgglomerativeClustering(2, linkage="ward").fit, features)[0]
    if importlib.util.find_spec("fastcluster") is None:
        return {**result, "fastcluster": "not installed"}
    fastcluster = importlib.import_module("fastcluster")
    for name in ("linkage", "linkage_vector"):
        result[f"fastcluster.{name}"], tree = seconds(getattr(fastcluster, name), features, "ward")
        assert np.allclose(tree[:, 2], expected[:, 2]), f"fastcluster.{name} gives another tree"
    return result


def large(rows: int, dimensions: int) -> dict[str, float | int]:
    """One tree of many rows: CPU time and the process's largest memory."""
    features = features_of(rows, dimensions)
    taken, _ = seconds(ward_tree, features)
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return {
        "rows": rows,
        "cpu_s": taken,
        "peak_mb": peak / 2**20,
        "features_mb": features.nbytes / 2**20,
        "all_distances_mb": rows * (rows - 1) / 2 * 8 / 2**20,
    }


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--rows", type=int, default=6_000)
    asks.add_argument("--dimensions", type=int, default=512)
    asks.add_argument("--trees", type=int, default=ATTRIBUTES, help="of the forty that are really built")
    asks.add_argument("--large", type=int, help="only one tree of so many rows")
    options = asks.parse_args()
    if options.large:
        results = {"large": large(options.large, options.dimensions)}
    else:
        features = features_of(options.rows, options.dimensions)
        results = {
            "rows": options.rows,
            "agreement": agreement(features),
            "one_tree_cpu_s": one_tree(features),
            "forty_attributes": forty_attributes(features, options.trees),
        }
    print(json.dumps(results, indent=1))
    publish(results, options.json)


if __name__ == "__main__":
    main()
