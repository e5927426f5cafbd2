"""Tables of results beside the paper's rows, and of preset ``paper``."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from derender.evaluation.paper_tables import LINEAR

RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"
PARTS = {"clustering": "attributes", "emotion": "emotion", "identity": "identity"}


def kept(name: str) -> Any:
    """A file of benchmarks/results."""
    return json.loads((RESULTS / name).read_text())


def beside_the_paper(_: Any) -> Iterator[list[str]]:
    """Accuracy of Ward clusters beside the paper's rows; other data, so other numbers of the controls."""
    parts = [kept(f"published/compare-{file}.json")["parts"][part] for file, part in PARTS.items()]
    yield ["", "CelebA", "emotion", "identity"]
    for name, row in parts[0]["rows"].items():
        yield [name + " (control)" * row["control"], *(shown(part["rows"][name]) for part in parts)]
    theirs = [{row["method"]: row["scores"]["accuracy"] for row in reversed(part["paper"])} for part in parts]
    for method in [row["method"] for row in parts[0]["paper"]]:
        yield [f"the paper: {method}", *(f"{part[method]:.3f}" for part in theirs)]


def few_labels(result: Any) -> Iterator[list[str]]:
    """Accuracy of the paper's head, frozen and fine-tuned, and the paper's own rows but StyleGAN2."""
    columns = [(head, count) for count in (100, 1000) for head in ("linear", "fine-tuned")]
    yield ["", *(f"{count:,} labels" + ", fine-tuned" * (head != "linear") for head, count in columns)]
    parts = {(one["head"], one["labels"]): one["rows"] for one in result["parts"]["attributes"]["parts"]}
    for name, row in parts["fine-tuned", 100].items():
        encoder = not row["control"] or name == "untrained encoder"
        has = {"linear": name in parts["linear", 100], "fine-tuned": encoder or name.startswith("ResNet")}
        yield [
            name + " (control)" * row["control"],
            *(shown(parts[head, count][name]) if has[head] else "" for head, count in columns),
        ]
    theirs: dict[str, dict[str, float]] = {}
    for line in LINEAR.paper:
        theirs.setdefault(line.method, {}).update(line.scores)
    for method, scores in theirs.items():
        cells = [scores.get(f"{head} {count}") for head, count in columns]
        if method != "StyleGAN2":
            yield [f"the paper: {method}", *("" if one is None else f"{one:.3f}" for one in cells)]


def shown(row: Any) -> str:
    """The accuracy of a row."""
    return f"{row['scores']['accuracy']['value']:.3f}"


def preset(result: Any) -> Iterator[list[str]]:
    yield ["LOOCC", "images", "ended with", "L1", "LFW, NMI", "pairs of LFW"]
    for row in result["rows"]:
        scores = (
            f"{row['l1 of held-out images']:.3f}",
            f"{row['LFW']['nmi']:.3f}",
            f"{row['pairs']['accuracy']:.3f}",
        )
        yield [row["loocc"], f"{row['images']:,}", row["ended"], *scores]
