"""One table of many data sets: rows are methods, then controls, and what failed keeps its place."""

from dataclasses import replace

import numpy as np

from derender.evaluation.bootstrap import ScoredRow, estimate
from derender.evaluation.score_table import Column
from derender.report.comparison import Question, summary_table


def question(name: str, absent: dict[str, str] | None = None, **accuracies: float) -> Question:
    rows = {}
    for method, value in accuracies.items():
        scores = {key: estimate([value], np.full(3, value)) for key in ("accuracy", "nmi")}
        rows[method] = ScoredRow(method, method == "pixels", 1, scores)
    columns = {key: Column(key, "high") for key in ("accuracy", "nmi")}
    return Question(name, columns, rows, absent or {})


def test_rows_are_methods_then_controls_and_what_failed_keeps_its_place():
    asked = [
        question("lfw", {"vqvae": "it was stopped by the watcher"}, ours=0.5, pixels=0.2),
        question("cars", ours=0.6, vqvae=0.4, pixels=0.3),
    ]
    table = summary_table("cluster", asked, ["ours", "vqvae"])
    assert [row.name for row in table.rows] == ["ours", "vqvae", "pixels"]
    assert [row.control for row in table.rows] == [False, False, True]
    assert table.values()["ours"] == {
        "lfw: accuracy": 0.5, "lfw: nmi": 0.5, "cars: accuracy": 0.6, "cars: nmi": 0.6
    }  # fmt: skip
    assert table.rows[1].cells == ["failed", None, 0.4, 0.4] and table.best(0) == 0.5
    few = [replace(one, columns={"accuracy": Column("balanced", "high")}) for one in asked[:1]]
    assert summary_table("linear", few, ["ours"]).caption.startswith("Few labels")
