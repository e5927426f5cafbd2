"""Search by one factor over a large table: exactness against scikit-learn, then time; the command apart.

Rows are generated: mixtures of 24 hidden numbers and noise, 256 numbers for each of four factors.
``--command`` also writes the table and times ``derender search`` as a process, beside one that only starts.

    .venv/bin/python benchmarks/search.py --json search.json
    .venv/bin/python benchmarks/search.py --rows 1000000 --command
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import parser, publish
from sklearn.neighbors import NearestNeighbors

from derender.features import FeatureTable
from derender.features.neighbours import nearest, same_image

FACTORS = ("geometry", "albedo", "light", "camera")
FOUND = 12


def table_of(rows: int, dimensions: int) -> FeatureTable:
    """Rectified mixtures and noise, float32, as codes are."""
    rng = np.random.default_rng(0)
    factors = {}
    for name in FACTORS:
        mixing = (rng.normal(size=(24, dimensions)) * 0.3).astype(np.float32)
        codes = rng.standard_normal((rows, 24), np.float32) @ mixing
        codes += 0.1 * rng.standard_normal((rows, dimensions), np.float32)
        factors[name] = np.maximum(codes, 0)
    return FeatureTable(tuple(f"{row:07}.png" for row in range(rows)), factors)


def best_of(rounds: int, function) -> dict[str, float]:
    """Least processor time (of processes it started, too) and least time by the clock, in seconds."""
    processor, clock = [], []
    for _ in range(rounds):
        start = processor_s(), time.perf_counter()
        function()
        processor.append(processor_s() - start[0])
        clock.append(time.perf_counter() - start[1])
    return {"processor_s": min(processor), "clock_s": min(clock)}


def processor_s() -> float:
    """Seconds of processor time so far, of this process and of those it waited for."""
    return sum(os.times()[:4])


def agreement(table: FeatureTable) -> None:
    """The same rows at the same distances as scikit-learn's brute force, or an AssertionError."""
    for factor in FACTORS[:2]:
        rows = table.factors[factor]
        queries = rows[:5] + np.float32(0.01)
        for metric in ("cosine", "euclidean"):
            results = [nearest(table, query, factor, FOUND, metric=metric) for query in queries]
            other = NearestNeighbors(n_neighbors=FOUND, metric=metric, algorithm="brute")
            distances, places = other.fit(rows.astype(np.float64)).kneighbors(queries.astype(np.float64))
            assert np.array_equal([one for one, _ in results], places), f"other rows by {factor}, {metric}"
            assert np.allclose([one for _, one in results], distances, atol=1e-7), (
                f"other distances by {factor}"
            )


def in_memory(table: FeatureTable, rounds: int) -> dict[str, dict[str, float]]:
    """One query by either distance, and looking for the image itself."""
    rows = table.factors["geometry"]
    codes = {name: values[7] for name, values in table.factors.items()}
    taken = {"same_image": best_of(rounds, lambda: same_image(table, codes))}
    for metric in ("cosine", "euclidean"):
        taken[metric] = best_of(rounds, lambda m=metric: nearest(table, rows[7], "geometry", FOUND, metric=m))
    return taken


def as_command(table: FeatureTable, rounds: int) -> dict[str, dict[str, float]]:
    """``derender search`` on a file, beside ``derender search --help`` (its start) and reading the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "F.parquet"
        table.write(path)
        start = [sys.executable, "-m", "derender", "search"]
        words = ["--features", str(path), "--like", table.files[7], "--factor", "geometry"]

        def run(*more: str) -> None:
            subprocess.run([*start, *more], check=True, capture_output=True)

        taken = {
            "read_table": best_of(rounds, lambda: FeatureTable.read(path)),
            "read_one_factor": best_of(rounds, lambda: FeatureTable.read(path, only="geometry")),
        }
        taken["command"] = best_of(rounds, lambda: run(*words))
        taken["command_help"] = best_of(rounds, lambda: run("--help"))
        return taken


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--rows", type=int, default=100_000)
    asks.add_argument("--dimensions", type=int, default=256)
    asks.add_argument("--rounds", type=int, default=5)
    asks.add_argument("--command", action="store_true", help="also time the command on a file")
    asked = asks.parse_args()
    table = table_of(asked.rows, asked.dimensions)
    agreement(table)
    results = {"rows": asked.rows, "dimensions": asked.dimensions, **in_memory(table, asked.rounds)}
    if asked.command:
        results |= as_command(table, asked.rounds)
    print(json.dumps(results, indent=1))
    publish(results, asked.json)


if __name__ == "__main__":
    main()
