"""Feature tables in DuckDB and FAISS: the code blocks of docs/how-to/scale.md, where these are installed."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from derender.features import FeatureTable
from derender.features.neighbours import search

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "scale.md"


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    geometry = np.random.default_rng(3).normal(size=(40, 8)).astype(np.float32)
    made = FeatureTable(tuple(f"{row:02d}.png" for row in range(40)), {"geometry": geometry}, {})
    made.write("features.parquet")
    return made


def run(tool: str, call: str, storage: str = "Flat") -> dict[str, Any]:
    pytest.importorskip(tool, reason=f"needs pip install {tool}")
    (block,) = [one for one in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if call in one]
    names: dict[str, Any] = {}
    exec(block.replace("128,Flat", f"128,{storage}"), names)
    return names


def test_duckdb_finds_the_rows_that_search_finds(table):
    (own, itself), *nearest = run("duckdb", "duckdb.sql")["nearest"]
    result = search(table, table.files[0], factor="geometry", k=9)
    assert own == table.files[0] and itself == pytest.approx(1)
    assert [file for file, _ in nearest] == [table.files[row] for row in result.rows]
    np.testing.assert_allclose([1 - one for _, one in nearest], result.distances, atol=1e-6)


def test_faiss_finds_the_rows_that_search_finds(table):
    names = run("faiss", "IndexFlatIP")
    for row, (similarity, nearest) in enumerate(zip(names["similarity"], names["neighbours"], strict=True)):
        result = search(table, table.files[row], factor="geometry", k=9)
        assert list(nearest) == [row, *result.rows]
        np.testing.assert_allclose(similarity[1:], 1 - np.array(result.distances), atol=1e-6)


@pytest.mark.parametrize("storage", ["Flat", "SQ8"])
def test_an_index_of_cells_finds_the_exact_neighbours(tmp_path, monkeypatch, storage):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(200, 24))[rng.integers(200, size=20_000)]
    rows = np.maximum((centres + rng.normal(size=(20_000, 24))) @ rng.normal(size=(24, 64)), 0)
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    files = tuple(f"{row}.png" for row in range(20_000))
    FeatureTable(files, {"geometry": rows}, {}).write("features.parquet")
    result = run("faiss", "IVF128,Flat", storage)["neighbours"]
    exact = np.argsort(-rows[:200] @ rows.T, axis=1)[:, :10]
    assert np.mean([len(np.intersect1d(*pair)) for pair in zip(result, exact, strict=True)]) > 9.5
