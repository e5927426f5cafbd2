"""Tables of measured speed and memory, each from the file of one benchmark: rows of cells, the head first."""

from collections.abc import Iterator
from typing import Any


def training_step(result: Any) -> Iterator[list[str]]:
    yield ["step of preset `paper`, batch 64", "images/s", "slowest to fastest", "ratio", "GFLOP an image"]
    for row in result["rows"]:
        low, high = row["spread"]
        rate, ratio = f"{row['images_per_second']:.2f}", f"{row['ratio']:.2f}"
        yield [row["name"], rate, f"{low:.2f} to {high:.2f}", ratio, f"{row['gflop_per_image']:.1f}"]


def step_profile(result: Any) -> Iterator[list[str]]:
    runs = result["rows"]
    names = {"32-true": "", "bf16-mixed": ", bfloat16"}
    heads = (f"`{run['preset']}`, {run['size']} px{names[run['precision']]}" for run in runs)
    yield ["share of a step's processor time", *heads]
    for part in sorted(runs[0]["shares"], key=runs[0]["shares"].__getitem__, reverse=True):
        yield [part, *(f"{run['shares'][part]:.1%}" for run in runs)]
    yield ["GFLOP a processor second", *(f"{run['gflop_per_cpu_s']:.0f}" for run in runs)]
    ceilings = (result["fastest_convolution"][run["precision"]] for run in runs)
    yield ["of the fastest convolution", *(f"{ceiling:.0f}" for ceiling in ceilings)]


def rasterize(result: Any) -> Iterator[list[str]]:
    yield ["64 depth maps of 64 x 64, ms an image", "plain torch", "Numba", "ratio"]
    for row in result["rows"]:
        ms = row["ms_per_image"]
        yield [row["part"], f"{ms['reference']:.3f}", f"{ms['numba']:.3f}", f"{row['ratio']:.1f}"]


def peers(result: Any) -> Iterator[list[str]]:
    yield [
        "16 depth maps, forward and backward, ms",
        *(f"{row['size']} x {row['size']}" for row in result["rows"]),
    ]
    for name in result["rows"][0]["milliseconds"]:
        yield [name, *(f"{row['milliseconds'][name]['both ways']:,.1f}" for row in result["rows"])]


def step_memory(result: Any) -> Iterator[list[str]]:
    yield ["image size", "whole batch, MB", "four chunks, MB", "whole, CPU s", "four chunks, CPU s"]
    by_size: dict[int, dict[int, Any]] = {}
    for row in result["rows"]:
        by_size.setdefault(row["size"], {})[row["chunks"]] = row
    for size, rows in by_size.items():
        mb = [f"{rows[chunks]['step_mb']:,.0f}" for chunks in (1, 4)]
        yield [f"{size} pixels", *mb, *(f"{rows[chunks]['cpu_seconds']:.0f}" for chunks in (1, 4))]


def million(result: Any) -> Iterator[list[str]]:
    yield ["1,000,000 rows of 512", "seconds", "accuracy", "ARI with the drawn groups"]
    for run in result["runs"]:
        scores = run["scores"]["scores"]
        cells = (f"{scores[key]['value']:.3f}" for key in ("accuracy", "ari"))
        yield [run["method"], f"{run['seconds']:.0f}", *cells]


def shares(result: Any) -> Iterator[list[str]]:
    yield ["median of five rounds", "ratio", "least to most", "images or rows a second"]
    for row in result["rows"]:
        speeds = f"{row['ours_per_second']:,.0f} / {row['theirs_per_second']:,.0f}"
        yield [row["what"], f"{row['ratio']:.2f}", f"{row['least']:.2f} to {row['most']:.2f}", speeds]


def fitting(result: Any) -> Iterator[list[str]]:
    size = f"{result['images']} scenes of 64 pixels, one thread"
    yield [size, "steps", "CPU ms an image", "SIDE x 100", "normals", "error of images"]
    yield ["feed-forward", "0", f"{result['feed_forward_ms_per_image']:.1f}", "", "", ""]
    for name, row in result["rows"].items():
        scores = f"{row['side']:.3f}", f"{row['mad_deg']:.1f}°", f"{row['error']:.4f}"
        yield [name, str(row["steps"]), f"{row['ms_per_image']:.1f}", *scores]


BEFORE = {"evaluate": "`evaluate disentangle`, 400 images", "embed": "`embed --model faces-64`, 3,000 images"}


def before(result: Any) -> Iterator[list[str]]:
    what = BEFORE[result["command"].split()[0]]
    yield [what, "seconds", "least to most", "processor seconds", "ratio"]
    first = result["rows"][0]["seconds"]
    for row, name in zip(result["rows"], (f"commit {result['commit']}", "now"), strict=True):
        ends = [f"{end(taken for taken, _ in row['rounds']):.0f}" for end in (min, max)]
        cells = [f"{row['seconds']:.0f}", " to ".join(ends), f"{row['processor_seconds']:.0f}"]
        yield [name, *cells, f"{first / row['seconds']:.2f}"]


def gpu_steps(result: Any) -> Iterator[list[str]]:
    yield ["one GPU", "launched one by one, images/s", "CUDA graph, images/s", "ratio", "memory, GB"]
    for batch, rate in result["literal"].items():
        yield [f"literal `paper`, 64 px, batch {batch}, float32", f"{float(rate):,.0f}", "", "", ""]
    ways: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in result["rows"]:
        key = row["preset"], row["size"], row["batch"], row["precision"]
        ways.setdefault(key, {})[row["cuda_graph"]] = row
    for (preset, size, batch, precision), rows in ways.items():
        extras = "bfloat16" if precision == "bf16-mixed" else "float32"
        fast, plain = rows["auto"]["images_per_second"], rows.get("off", {}).get("images_per_second")
        one, ratio = ("", "") if plain is None else (f"{plain:,.0f}", f"{fast / plain:.1f}")
        what = f"`{preset}`, {size} px, batch {batch}, {extras}"
        yield [what, one, f"{fast:,.0f}", ratio, f"{rows['auto']['memory_gb']:.1f}"]


def million_rows(result: Any) -> Iterator[list[str]]:
    yield ["1,000,000 rows of 128, one thread", "seconds"]
    names = {
        "faiss_build": f"FAISS, index of {result['lists']:,} cells",
        "faiss_search": f"FAISS, {result['queries']} queries, recall {result['recall']}",
        "exact_search": f"exact, {result['queries']} queries",
        "duckdb_nearest_one": "DuckDB, one exact query",
        "duckdb_count": "DuckDB, rows of each kind",
    }
    yield from ([name, f"{result['seconds'][key]:.2f}"] for key, name in names.items())
