"""Many rows: cells hold near rows, and what is clustered by cells is near what is clustered exactly."""

import numpy as np
import pytest
from scipy.cluster.hierarchy import is_valid_linkage
from sklearn.metrics import adjusted_rand_score

from derender.cli import main
from derender.evaluation import neighbours
from derender.evaluation.cells import cells, members
from derender.evaluation.clustering_finch import finch
from derender.evaluation.clustering_methods import approximation, clusterings
from derender.evaluation.clustering_ward import cut, ward_tree
from derender.evaluation.clustering_ward_cells import cut_leaves, ward_in_cells
from derender.evaluation.neighbours import finite_rows, nearest_rows
from derender.features import FeatureTable


def blobs(rows: int, seed: int, count: int = 7, apart: float = 3.0, dimensions: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centres = apart * rng.normal(size=(count, dimensions))
    return (rng.normal(size=(rows, dimensions)) + centres[np.arange(rows) % count]).astype(np.float32)


@pytest.fixture
def many(monkeypatch) -> None:
    """What has more than 300 rows counts as very many; a cell holds 40."""
    monkeypatch.setattr(neighbours, "EXACT_ROWS", 300)
    monkeypatch.setattr(neighbours, "CELL_ROWS", 40)


@pytest.mark.parametrize("points", [blobs(500, 0), np.zeros((500, 3), np.float32), blobs(30, 1)])
def test_cells_hold_every_row_once_and_are_not_too_large(points):
    groups = members(cells(points, 40))
    assert sorted(np.concatenate(groups).tolist()) == list(range(len(points)))
    assert max(map(len, groups)) <= 160
    assert all((np.diff(rows) > 0).all() for rows in groups)


def test_cells_keep_near_rows_together_and_repeat():
    points = blobs(600, 2, count=4, apart=20)
    found = cells(points, 60, seed=5)
    together = sum(np.bincount(rows % 4).max() for rows in members(found))
    assert together > 0.9 * len(points)
    assert np.array_equal(found, cells(points, 60, seed=5))


@pytest.mark.parametrize("metric", ["cosine", "euclidean"])
def test_nearest_rows_by_cells_are_mostly_the_nearest(many, monkeypatch, metric):
    points = blobs(900, 3)
    by_cells, near = nearest_rows(points, metric)
    monkeypatch.setattr(neighbours, "EXACT_ROWS", 1_000)
    expected, nearest = nearest_rows(points, metric)
    same = by_cells == expected
    assert 0.85 < same.mean() <= 1
    assert (near >= nearest - 1e-5).all() and (by_cells != np.arange(900)).all()
    np.testing.assert_allclose(near[same], nearest[same], atol=1e-4)  # float32 against float64


def test_ward_with_sizes_goes_on_where_a_tree_stopped():
    points = blobs(200, 4).astype(np.float64)
    whole = ward_tree(points)
    leaf = cut(whole, 30)
    sizes = np.bincount(leaf)
    means = np.stack([points[leaf == one].mean(axis=0) for one in range(30)])
    rest = ward_tree(means, sizes)
    np.testing.assert_allclose(rest[:, 2], whole[-29:, 2], rtol=1e-9)
    np.testing.assert_array_equal(rest[:, 3], whole[-29:, 3])


def test_ward_by_cells_is_ward_where_no_merge_crosses_a_border():
    points = blobs(600, 5, count=6, apart=30)
    found, exact = ward_in_cells(points, leaves=60, rows_per_cell=100), ward_tree(points)
    assert is_valid_linkage(ward_tree(points)) and len(np.unique(found.leaf)) == len(found.tree) + 1 == 60
    for count in (2, 4, 6):
        assert adjusted_rand_score(cut_leaves(found, count), cut(exact, count)) == 1
    with pytest.raises(ValueError, match="keeps 60 leaves of 600 rows, cannot make 61 clusters: ask"):
        cut_leaves(found, 61)


def test_ward_by_cells_is_near_ward_where_they_do():
    points = blobs(900, 6, count=5, apart=3)
    found, exact = ward_in_cells(points, leaves=100, rows_per_cell=60), ward_tree(points)
    assert adjusted_rand_score(cut_leaves(found, 5), cut(exact, 5)) > 0.85
    dealt = np.random.default_rng(0).permutation(cut_leaves(found, 5))
    assert abs(adjusted_rand_score(dealt, cut(exact, 5))) < 0.05


def test_one_cell_and_copies():
    assert cut_leaves(ward_in_cells(blobs(20, 7), leaves=20), 3).max() == 2
    copies = ward_in_cells(np.zeros((500, 2)), leaves=10, rows_per_cell=50)
    assert len(np.unique(cut_leaves(copies, 4))) == 4


@pytest.mark.parametrize("method", ["ward", "finch", "k-means"])
def test_every_method_takes_many_rows_and_says_that_it_is_approximate(many, method):
    points = blobs(800, 8, count=4, apart=30)
    assert finite_rows(points, "a test").dtype == np.float32
    assert adjusted_rand_score(clusterings(points, [4], method)[4], np.arange(800) % 4) == 1
    assert method in approximation(method, 800) and approximation(method, 300) == ""


def test_finch_by_cells_has_the_levels_of_finch(many, monkeypatch):
    points = blobs(700, 9, count=5, apart=10)
    by_cells = finch(points, "euclidean")
    monkeypatch.setattr(neighbours, "EXACT_ROWS", 1_000)
    exact = finch(points, "euclidean")
    assert abs(by_cells.counts[0] / exact.counts[0] - 1) < 0.1
    assert adjusted_rand_score(by_cells.partitions[0], exact.partitions[0]) > 0.8


def test_the_command_notes_the_approximation(many, tmp_path, capsys):
    labels = {"kind": np.array(list("abcd"))[np.arange(400) % 4]}
    table = FeatureTable(tuple(map(str, range(400))), {"geometry": blobs(400, 1, count=4, apart=30)}, labels)
    table.write(tmp_path / "t.parquet")
    command = ["evaluate", "cluster", "--features", str(tmp_path / "t.parquet"), "--label", "kind"]
    assert main([*command, "--factors", "geometry"]) == 0
    said = capsys.readouterr()
    assert "400 rows are more than 300, so ward is approximate" in said.out + said.err
