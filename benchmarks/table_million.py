"""A feature table of a million rows through tools made for that: FAISS for neighbours, DuckDB for SQL.

A table of mixtures is written, 50,000 rows in memory at a time. FAISS gets an inverted-file index of one
factor by cosine, read a row group at a time; its neighbours are compared with exact search. DuckDB reads the
parquet file where it lies.

    pip install '.[scale]'
    python benchmarks/table_million.py --json benchmarks/results/table_million.json
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from clustering_million import BLOCK, block
from machine import parser, publish

from derender.features import FeatureTable
from derender.features.parquet import write_tables

FACTOR, NEIGHBOURS, QUERIES = "geometry", 10, 200


def write_table(file: Path, rows: int, dimensions: int = 128) -> None:
    """A table of so many rows, as `derender embed` writes it."""

    def groups() -> Iterator[FeatureTable]:
        for number, start in enumerate(range(0, rows, BLOCK)):
            features, kinds = block(number, min(BLOCK, rows - start))
            files = tuple(f"{start + row:08d}.jpg" for row in range(len(kinds)))
            yield FeatureTable(files, {FACTOR: features[:, :dimensions]}, {"kind": kinds})

    write_tables(file, groups())


def factor_of(file: Path) -> Iterator[np.ndarray]:
    """One factor's rows, unit length, a batch at a time."""
    for batch in pq.ParquetFile(file).iter_batches(BLOCK, columns=[FACTOR]):
        column = batch.column(0)
        rows = column.flatten().to_numpy().reshape(len(column), -1).astype(np.float32, copy=False)
        yield rows / np.linalg.norm(rows, axis=1, keepdims=True)


def index_of(file: Path, lists: int, looked_into: int) -> Any:
    """FAISS's inverted lists of one factor, inner product of unit vectors; trained on the first batch."""
    import faiss

    index = None
    for rows in factor_of(file):
        if index is None:
            index = faiss.IndexIVFFlat(
                faiss.IndexFlatIP(rows.shape[1]), rows.shape[1], lists, faiss.METRIC_INNER_PRODUCT
            )
            index.train(rows)
            index.nprobe = looked_into
        index.add(rows)
    return index


def exact(file: Path, queries: np.ndarray) -> np.ndarray:
    """Row numbers of each query's nearest rows by cosine, nearest first."""
    best, names = np.zeros((len(queries), 0), np.float32), np.zeros((len(queries), 0), np.int64)
    start = 0
    for rows in factor_of(file):
        best = np.concatenate([best, queries @ rows.T], axis=1)
        added = np.arange(start, start + len(rows))
        names = np.concatenate([names, np.broadcast_to(added, (len(queries), len(rows)))], axis=1)
        kept = np.argpartition(-best, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
        best, names = (np.take_along_axis(each, kept, axis=1) for each in (best, names))
        start += len(rows)
    return np.take_along_axis(names, np.argsort(-best, axis=1, kind="stable"), axis=1)


def nearest_by_sql(file: Path, row: int) -> list[tuple[str, float]]:
    """Names and cosines of the rows nearest to one row of the file, by DuckDB."""
    import duckdb

    return duckdb.execute(
        f"""
        WITH query AS (SELECT {FACTOR} AS own FROM read_parquet($file) WHERE file = $name)
        SELECT file, list_cosine_similarity({FACTOR}, own) AS cosine
        FROM read_parquet($file), query ORDER BY cosine DESC, file LIMIT {NEIGHBOURS}
        """,
        {"file": str(file), "name": f"{row:08d}.jpg"},
    ).fetchall()


def counts_by_sql(file: Path) -> dict[int, int]:
    """How many rows each kind has, by DuckDB."""
    import duckdb

    query = "SELECT kind, count(*) FROM read_parquet($file) GROUP BY kind ORDER BY kind"
    return dict(duckdb.execute(query, {"file": str(file)}).fetchall())


def measure(file: Path, rows: int, lists: int, looked_into: int) -> dict[str, Any]:
    """Seconds of every recipe, and how many of the exact neighbours FAISS finds."""
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        result = work()
        seconds[name] = round(time.perf_counter() - began, 4)
        return result

    timed("write", lambda: write_table(file, rows))
    places = np.random.default_rng(0).permutation(min(rows, BLOCK))[:QUERIES]
    queries = next(factor_of(file))[places]
    index = timed("faiss_build", lambda: index_of(file, lists, looked_into))
    result = timed("faiss_search", lambda: index.search(queries, NEIGHBOURS))[1]
    true = timed("exact_search", lambda: exact(file, queries))
    by_sql = timed("duckdb_nearest_one", lambda: nearest_by_sql(file, int(places[0])))
    counts = timed("duckdb_count", lambda: counts_by_sql(file))
    recall = np.mean([len(np.intersect1d(a, b)) for a, b in zip(result, true, strict=True)]) / NEIGHBOURS
    same = len({name for name, _ in by_sql} & {f"{row:08d}.jpg" for row in true[0]}) / NEIGHBOURS
    return {
        "rows": rows, "queries": len(queries), "neighbours": NEIGHBOURS, "lists": lists,
        "looked_into": looked_into, "recall": float(recall), "duckdb_agrees": same,
        "counted": sum(counts.values()), "megabytes": round(file.stat().st_size / 1e6), "seconds": seconds,
    }  # fmt: skip


if __name__ == "__main__":
    options = parser(__doc__)
    options.add_argument("--rows", type=int, default=1_000_000)
    options.add_argument("--lists", type=int, default=1024, help="cells of FAISS's index")
    options.add_argument("--looked-into", type=int, default=32, help="cells that a query searches")
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        numbers = measure(Path(folder) / "table.parquet", chosen.rows, chosen.lists, chosen.looked_into)
    print(numbers)
    publish(numbers, chosen.json)
