"""A million rows of 512 numbers through `derender evaluate cluster`, and how far that is from exact.

How far: on as many rows as exact clustering can take, each method is asked to do both, exactly and as it does
above 100,000 rows; the adjusted Rand index between the two is given, that of two exact clusterings of halves
of the columns for scale, and how many nearest rows the cells find. Then the command itself: a table of
rectified mixtures is written, and clustered in a process of its own whose seconds and highest memory count.

    python benchmarks/clustering_million.py --json benchmarks/results/clustering_million.json
    python benchmarks/clustering_million.py --rows 0 --checked 6000          # only how far
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from machine import parser, publish
from sklearn.metrics import adjusted_rand_score

from derender.evaluation import neighbours
from derender.evaluation.clustering_methods import (
    clusterings,
    cut,
    finch,
    ward_in_cells,
    ward_tree,
)
from derender.evaluation.neighbours import nearest_rows

CLASSES, DIMENSIONS = 40, 512
COUNTS = (2, 10, 40, 100)
BLOCK = 50_000


def block(number: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Rectified mixtures of 24 hidden numbers, moved by a class: (rows, 512) float32, and the classes."""
    shared, rng = np.random.default_rng(0), np.random.default_rng(1000 + number)
    mixing = shared.normal(size=(24, DIMENSIONS)).astype(np.float32) * 0.3
    centres = shared.normal(size=(CLASSES, 24)).astype(np.float32)
    kinds = rng.integers(CLASSES, size=rows)
    hidden = rng.standard_normal((rows, 24), np.float32) + centres[kinds]
    noise = 0.1 * rng.standard_normal((rows, DIMENSIONS), np.float32)
    return np.maximum(hidden @ mixing + noise, 0), kinds


def write_table(file: Path, rows: int) -> None:
    """A feature table of so many rows, 50,000 in memory at a time."""
    schema = pa.schema(
        [
            ("file", pa.string()),
            ("geometry", pa.list_(pa.float32(), DIMENSIONS)),
            ("kind", pa.string()),
        ]
    )
    with pq.ParquetWriter(file, schema, use_dictionary=["kind"], compression="none") as writer:
        for number, start in enumerate(range(0, rows, BLOCK)):
            features, kinds = block(number, min(BLOCK, rows - start))
            columns = [
                pa.array([f"{start + row:08d}.jpg" for row in range(len(kinds))]),
                pa.FixedSizeListArray.from_arrays(pa.array(features.ravel()), DIMENSIONS),
                pa.array([f"k{kind:02d}" for kind in kinds]),
            ]
            writer.write_table(pa.table(columns, schema=schema))


def how_far(rows: int) -> dict[str, Any]:
    """Exact against approximate on the same rows."""
    features = block(0, rows)[0]
    cell = max(50, rows * neighbours.CELL_ROWS // 1_000_000)  # as many cells as a million rows get
    leaves = max(200, rows * 16_384 // 1_000_000)
    result: dict[str, Any] = {"rows": rows, "rows_per_cell": cell, "leaves": leaves}
    began = time.perf_counter()
    tree = ward_tree(features)
    result["exact_ward_s"], began = time.perf_counter() - began, time.perf_counter()
    results = ward_in_cells(features, leaves, cell)
    result["ward_in_cells_s"] = time.perf_counter() - began
    few_leaves = ward_in_cells(features, leaves, neighbours.CELL_ROWS)
    half = ward_tree(features[:, ::2])
    for count in (one for one in COUNTS if one <= leaves):
        exact = cut(tree, count)
        result[f"ward_ari_{count}"] = adjusted_rand_score(cut(n_clusters=count, **results), exact)
        result[f"ward_ari_{count}_cells_of_2000"] = adjusted_rand_score(
            cut(n_clusters=count, **few_leaves), exact
        )
        result[f"ward_ari_{count}_half_the_columns"] = adjusted_rand_score(cut(half, count), exact)
    means, nearest = clusterings(features, (CLASSES,), "k-means"), nearest_rows(features)[0]
    levels = finch(features)
    exact_rows, cell_rows = neighbours.EXACT_ROWS, neighbours.CELL_ROWS
    try:
        neighbours.EXACT_ROWS, neighbours.CELL_ROWS = 0, cell
        batches = clusterings(features, (CLASSES,), "k-means")
        result["k_means_ari_40"] = adjusted_rand_score(means[CLASSES], batches[CLASSES])
        result["nearest_found"] = float((nearest_rows(features)[0] == nearest).mean())
        near = finch(features)
    finally:
        neighbours.EXACT_ROWS, neighbours.CELL_ROWS = exact_rows, cell_rows
    result["finch_counts"], result["finch_counts_by_cells"] = levels.counts, near.counts
    result["finch_ari_finest"] = adjusted_rand_score(levels.partitions[0], near.partitions[0])
    return result


def through_the_command(table: Path, method: str, folder: Path) -> dict[str, Any]:
    """Seconds and highest memory of the whole command, and the scores it gives."""
    scores = folder / f"{method}.json"
    command = ["evaluate", "cluster", "--features", str(table), "--label", "kind", "--factors", "geometry"]
    command += ["--method", method, "--resamples", "20", "--json", str(scores)]
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "derender", *command], capture_output=True, text=True, check=False,
        env={**os.environ, "DERENDER_CACHE": str(folder / "cache")},  # where results would be remembered
    )  # fmt: skip
    taken = time.perf_counter() - began
    if done.returncode:
        raise SystemExit(f"{method}: {done.stdout}{done.stderr}")
    values = json.loads(scores.read_text())
    unit = 1 if sys.platform == "darwin" else 1024
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)  # the largest of all children so far
    return {
        "method": method, "seconds": taken, "peak_mb_so_far": usage.ru_maxrss * unit / 1e6,
        "approximation": values["approximation"], "scores": next(iter(values["rows"].values())),
    }  # fmt: skip


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--rows", type=int, default=1_000_000, help="of the table; 0 leaves the command out")
    asks.add_argument("--checked", type=int, nargs="*", default=[6_000], help="rows to compare with exact")
    asks.add_argument("--methods", nargs="+", default=["ward", "k-means", "finch"])
    asks.add_argument("--folder", type=Path, help="where the table is put meanwhile (2 KB a row)")
    options = asks.parse_args()
    result: dict[str, Any] = {"benchmark": "clustering a million rows", "checked": [], "runs": []}

    for rows in options.checked:
        result["checked"].append(how_far(rows))
        print(json.dumps(result["checked"][-1], indent=1), flush=True)
        publish(result, options.json)
    if not options.rows:
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        table = Path(name) / "features.parquet"
        write_table(table, options.rows)
        result["table"] = {"rows": options.rows, "numbers": DIMENSIONS, "mb": table.stat().st_size / 1e6}
        for method in options.methods:
            result["runs"].append(through_the_command(table, method, Path(name)))
            row = result["runs"][-1]
            print(f"{options.rows:,} rows, {method}: {row['seconds']:.0f} s, {row['peak_mb_so_far']:,.0f} MB")
            publish(result, options.json)


if __name__ == "__main__":
    main()
