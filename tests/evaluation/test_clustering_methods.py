"""Ward in bounded memory against SciPy, FINCH against its authors' package, one tree for many cuts; very many
rows by cells against the exact methods."""

import tracemalloc
import warnings
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import is_valid_linkage, linkage
from sklearn.metrics import adjusted_rand_score, pairwise_distances

from derender.evaluation import clustering_methods, neighbours
from derender.evaluation.clustering import finch_levels
from derender.evaluation.clustering_methods import clusterings, cut, finch, ward_tree
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import cells, finite_rows, nearest_rows

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # it says at import that its approximate search is not installed
    from finch import FINCH


def groups(rows: int, seed: int, dimensions: int = 6, count: int = 7, apart: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(rows, dimensions))
    return noise + apart * rng.normal(size=(count, dimensions))[np.arange(rows) % count]


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 60), st.integers(1, 5), st.integers(0, 99))
def test_ward_is_scipys_tree(rows, dimensions, seed):
    features = np.random.default_rng(seed).normal(size=(rows, dimensions))
    ours, theirs = ward_tree(features), linkage(features, "ward")
    assert is_valid_linkage(ours)
    np.testing.assert_allclose(ours[:, 2], theirs[:, 2], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(ours, np.column_stack((theirs[:, :2], ours[:, 2], theirs[:, 3])))


@pytest.mark.parametrize("float64_rows", [20_000, 0])
def test_blocks_and_float32_do_not_change_the_tree(monkeypatch, float64_rows):
    features = 100 + groups(203, 1)
    monkeypatch.setattr(clustering_methods, "NUMBERS_AT_ONCE", 600)
    monkeypatch.setattr(clustering_methods, "FLOAT64_ROWS", float64_rows)
    ours, theirs = ward_tree(features), linkage(features, "ward")
    np.testing.assert_allclose(ours[:, 2], theirs[:, 2], rtol=1e-9)
    for count in (2, 7, 50):
        assert adjusted_rand_score(cut(ours, count), cut(theirs, count)) == 1


def test_ties_and_copies_still_make_a_valid_tree():
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    features = np.vstack([grid, grid[:7], grid[:7]])
    tree = ward_tree(features)
    assert is_valid_linkage(tree) and (tree[:14, 2] == 0).all()
    assert (np.diff(tree[:, 2]) >= 0).all() and tree[-1, 3] == len(features)


def test_ward_holds_no_square_of_the_rows():
    features = np.random.default_rng(0).normal(size=(3_500, 4))
    tracemalloc.start()
    ward_tree(features)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.6 * 3_500**2 / 2 * 8, f"{peak / 1e6:.0f} MB"  # SciPy holds the distances: 49 MB


def test_nearest_rows_are_those_of_all_distances(monkeypatch):
    monkeypatch.setattr(neighbours, "NUMBERS_AT_ONCE", 16 * 53)
    features = groups(53, 3)
    features[5] = 0
    distances = pairwise_distances(features, metric="cosine")
    np.fill_diagonal(distances, np.inf)
    result, distance = nearest_rows(features)
    np.testing.assert_allclose(distance, distances.min(axis=1), atol=1e-7)
    np.testing.assert_allclose(distances[np.arange(53), result], distances.min(axis=1), atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_finch_is_its_authors(seed):
    features = groups(150, seed, dimensions=8)
    theirs, counts, required = FINCH(features, req_clust=5, distance="cosine", verbose=False)
    ours = finch(features)
    assert list(ours.counts) == [int(count) for count in counts]
    for level, partition in enumerate(ours.partitions):
        assert adjusted_rand_score(theirs[:, level], partition) == 1
    assert adjusted_rand_score(required, clustering_methods.finch_clusters(features, 5)) == 1


def test_finch_levels_are_nested_and_scored_beside_chance():
    features = groups(140, 2, count=5)
    labels = (np.arange(140) % 5).astype(float)
    labels[0] = np.nan
    levels = finch_levels(features, labels)
    assert [level.clusters for level in levels] == sorted((level.clusters for level in levels), reverse=True)
    assert levels[0].scores["accuracy"] > levels[0].chance["accuracy"] + 0.2
    partitions = finch(features).partitions
    for fine, coarse in pairwise(partitions):
        assert len(np.unique(np.column_stack((fine, coarse)), axis=0)) == fine.max() + 1


def test_forty_attributes_cost_one_tree(monkeypatch, tmp_path):
    built = []
    monkeypatch.setattr(clustering_methods, "ward_tree", lambda of: built.append(1) or ward_tree(of))
    features = groups(40, 0)
    cuts = clusterings(features, [2] * 40 + [5], "ward", memory=Memory(tmp_path))
    assert len(built) == 1 and sorted(cuts) == [2, 5]
    again = clusterings(features, [3, 5], "ward", memory=Memory(tmp_path))
    assert len(built) == 1 and np.array_equal(again[5], cuts[5])
    clusterings(features + 1, [2], "ward", memory=Memory(tmp_path))
    assert len(built) == 2


@pytest.mark.parametrize(
    ("features", "counts", "method", "message"),
    [
        (np.ones((3, 2)), [4], "ward", "cannot make 4 clusters of 3 rows: ask for 1 to 3"),
        (np.ones((3, 2)), [4], "k-means", "cannot make 4 clusters of 3 rows"),
        (np.eye(6), [6], "finch", "finest partition of 6 rows has 1 clusters, cannot make 6"),
        (np.ones((3, 2)), [2], "wards", "unknown method 'wards'; did you mean 'ward'"),
        (np.array([[1.0], [np.nan]]), [1], "finch", "not finite in 1 of 2 rows"),
        (np.ones((1, 2)), [1], "ward", "takes 2 rows or more, got 1"),
        (np.ones(4), [1], "k-means", r"must be \(rows, dimensions\), got shape \(4,\)"),
    ],
)
def test_bad_input_is_refused_in_words(features, counts, method, message):
    with pytest.raises(ValueError, match=message):
        clusterings(features, counts, method)


@pytest.fixture
def many(monkeypatch) -> None:
    """What has more than 300 rows counts as very many; a cell holds 40."""
    monkeypatch.setattr(neighbours, "EXACT_ROWS", 300)
    monkeypatch.setattr(neighbours, "CELL_ROWS", 40)


@pytest.mark.parametrize("points", [groups(500, 0), np.zeros((500, 3), np.float32), groups(30, 1)])
def test_cells_hold_every_row_once_and_are_not_too_large(points):
    groups = cells(points.astype(np.float32), 40)
    assert sorted(np.concatenate(groups).tolist()) == list(range(len(points)))
    assert max(map(len, groups)) <= 160
    assert all((np.diff(rows) > 0).all() for rows in groups)


def test_nearest_rows_by_cells_are_mostly_the_nearest(many, monkeypatch):
    points = groups(900, 3)
    by_cells, near = nearest_rows(points)
    monkeypatch.setattr(neighbours, "EXACT_ROWS", 1_000)
    expected, nearest = nearest_rows(points)
    same = by_cells == expected
    assert 0.85 < same.mean() <= 1
    assert (near >= nearest - 1e-5).all() and (by_cells != np.arange(900)).all()
    np.testing.assert_allclose(near[same], nearest[same], atol=1e-4)  # float32 against float64


def test_ward_by_cells_is_ward_where_no_merge_crosses_a_border():
    points = groups(600, 5, count=6, apart=30)
    result = clustering_methods.ward_in_cells(points, leaves=60, rows_per_cell=100)
    exact = ward_tree(points)
    assert is_valid_linkage(exact) and len(np.unique(result["leaf"])) == len(result["tree"]) + 1 == 60
    for count in (2, 4, 6):
        assert adjusted_rand_score(cut(n_clusters=count, **result), cut(exact, count)) == 1
    with pytest.raises(ValueError, match="cannot make 61 clusters of 60 leaves"):
        cut(n_clusters=61, **result)


@pytest.mark.parametrize("method", ["ward", "finch", "k-means"])
def test_every_method_takes_many_rows_and_says_that_it_is_approximate(many, method):
    points = groups(800, 8, count=4, apart=30)
    assert finite_rows(points, "a test").dtype == np.float32
    assert adjusted_rand_score(clusterings(points, [4], method)[4], np.arange(800) % 4) == 1
    told = clustering_methods.approximation
    assert method in told(method, 800) and told(method, 300) == ""
