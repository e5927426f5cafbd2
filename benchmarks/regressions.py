"""The rows of the regression table in docs/performance.md that follow from benchmarks/results.

Prints Markdown: day and commit, machine, what was measured, the ratio (or seconds, or megabytes). A file that
is missing or of another form is named and passed over.

    python benchmarks/regressions.py
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
Reader = Callable[[dict[str, Any]], Iterator[tuple[str, str]]]


def by_row(what: str, result: str) -> Reader:
    """A reader of files that hold one figure a row."""
    return lambda results: ((what.format(**row), result.format(**row)) for row in results["rows"])


def training_step(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for row in result["rows"][1:]:
        yield f"training step, {row['name']} / literal", f"{row['ratio']:.2f}x"


def rasterize_peers(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for row in result["rows"]:
        what = f"rasterise both ways, {row['maps']} maps of {row['size']}x{row['size']}"
        ours = row["milliseconds"]["derender, Numba"]["both ways"]
        for name, check in row["checks"].items():
            if name != "derender, Numba":
                note = "" if check["exact"] else f" (not exact: gradient off by {check['gradient_off']:.0%})"
                yield f"{what}, {name}{note} / ours", f"{row['milliseconds'][name]['both ways'] / ours:.1f}x"


def embedding(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for way, ratio in result["against_training"].items():
        if way != "training step":
            yield f"{way} / training step, preset paper ({result['clock']} clock)", f"{ratio:.1f}x"


def reading(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for kind, row in result["starts"].items():
        later = min(one["known_s"] for one in row["later"])
        what = f"{kind} of {row['files']:,} known, first start and later"
        yield what, f"{row['first']['known_s']:.1f} s, {later:.1f} s"


def clustering(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    forty = result["forty_attributes"]
    yield (
        f"forty attributes from one tree of {result['rows']:,} rows / a tree for each",
        f"{forty['ratio']:.0f}x",
    )
    yield "the same / SciPy's tree for each", f"{forty['ratio_to_scipy']:.0f}x"
    for name, taken in result["one_tree_cpu_s"].items():
        if name != "ours" and not isinstance(taken, str):
            ratio = taken / result["one_tree_cpu_s"]["ours"]
            yield f"one tree of {result['rows']:,} rows, CPU seconds, {name} / ours", f"{ratio:.2f}x"


def clustering_million(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for row in result["checked"]:
        indices = [row[name] for name in row if name.startswith("ward_ari_") and name[9:].isdigit()]
        yield (
            f"Ward by cells against exact, {row['rows']:,} rows, ARI",
            f"{min(indices):.2f}..{max(indices):.2f}",
        )
        yield f"nearest rows that cells find, {row['rows']:,} rows", f"{row['nearest_found']:.1%}"
    for row in result["runs"]:
        rows = result["table"]["rows"]
        yield f"evaluate cluster, {rows:,} rows of 512, {row['method']}", f"{row['seconds']:.0f} s"


def bench(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for row in result["rows"]:
        yield f"derender bench: {row['what']}", f"{row['ratio']:.2f}x ({row['least']:.2f}..{row['most']:.2f})"
    yield "derender bench: training waits for data", f"{result['waiting']['share']:.2%}"


def torchrun_resume(result: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for way, apart in result["differences"].items():
        yield f"torchrun: {way}, largest difference from one process", f"{apart:.1e}"


READERS: dict[str, Reader] = {
    "training_step": training_step,
    "rasterize": by_row("{part}, torch / Numba", "{ratio:.1f}x"),
    "rasterize_peers": rasterize_peers,
    "embedding": embedding,
    "bench": bench,
    "embedding_memory": by_row("memory of embedding {pictures:,} images", "{peak_mb:,.0f} MB"),
    "step_memory": by_row(
        "memory of a step, {size} px, batch {batch}, {chunks} chunks", "{mb_per_picture:,.0f} MB an image"
    ),
    "reading": reading,
    "clustering": clustering,
    "clustering_million": clustering_million,
    "torchrun_resume": torchrun_resume,
    "clustering_how_far": clustering_million,
    "clustering_how_far_50000": clustering_million,
}


def main() -> None:
    print("| date, commit | machine | what | result |\n|---|---|---|---|")
    for name, reader in READERS.items():
        file = RESULTS / f"{name}.json"
        try:
            results = json.loads(file.read_text())
            rows = list(reader(results))
        except FileNotFoundError:
            print(f"<!-- {file.name} is not there -->")
            continue
        except (LookupError, TypeError, ValueError) as problem:
            print(f"<!-- {file.name} cannot be read: {type(problem).__name__} {problem} -->")
            continue
        machine = results.get("machine", results)
        when = f"{machine.get('date', '')}, {machine.get('commit', '')}".strip(", ")
        where = f"{machine.get('cores', '?')} cores, {machine.get('processor', machine.get('device', '?'))}"
        for what, result in rows:
            print(f"| {when} | {where} | {what} | {result} |")


if __name__ == "__main__":
    main()
