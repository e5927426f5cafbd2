"""FAISS and DuckDB read our feature tables: they find what exact search finds (skips without them)."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from derender.features import FeatureTable
from derender.features.neighbours import nearest

ROWS = 3_000


@pytest.fixture(scope="module")
def recipes():
    folder = Path(__file__).parents[2] / "benchmarks"
    sys.path.insert(0, str(folder))
    try:
        spec = importlib.util.spec_from_file_location("table_million", folder / "table_million.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    return module


@pytest.fixture(scope="module")
def file(recipes, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("tools") / "table.parquet"
    recipes.write_table(path, ROWS, 32)
    return path


def test_exact_search_is_ours(recipes, file):
    table = FeatureTable.read(file)
    queries = next(recipes.factor_of(file))[:5]
    found = recipes.exact(file, queries)
    for row, names in enumerate(found):
        assert np.array_equal(names, nearest(table, table.factors["geometry"][row], "geometry", 10)[0])


def test_faiss_finds_the_nearest_rows(recipes, file):
    pytest.importorskip("faiss")
    queries = next(recipes.factor_of(file))[:50]
    true, recall = recipes.exact(file, queries), {}
    for looked_into in (1, 16):
        found = recipes.index_of(file, 16, looked_into).search(queries, 10)[1]
        recall[looked_into] = np.mean([np.isin(a, b).mean() for a, b in zip(found, true, strict=True)])
    assert recall[16] > 0.99 > recall[1] > 0.3


def test_duckdb_reads_the_file_where_it_lies(recipes, file):
    pytest.importorskip("duckdb")
    table = FeatureTable.read(file)
    expected = nearest(table, table.factors["geometry"][7], "geometry", 10)[0]
    assert [name for name, _ in recipes.nearest_by_sql(file, 7)] == [table.files[row] for row in expected]
    kinds, counts = np.unique(table.labels["kind"], return_counts=True)
    assert recipes.counts_by_sql(file) == dict(zip(kinds.tolist(), counts.tolist(), strict=True))
