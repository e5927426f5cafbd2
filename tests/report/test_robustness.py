"""Curves as tables and as a chart: what stands in which cell, and a line for each row."""

import numpy as np

from derender.evaluation.bootstrap import ScoredRow, estimate, with_verdicts
from derender.evaluation.robust import CurveResult, RobustnessComparison


def test_tables_say_what_was_learned_tested_and_lost():
    def row(name: str, control: bool, area: float, ends: tuple[float, float]) -> ScoredRow:
        named = {"ordinary": ends[0], "area": area, "0 deg": ends[0], "40 deg": ends[1]}
        drawn = np.linspace(-0.01, 0.01, 5)
        scores = {key: estimate([value - 0.1, value + 0.1], value + drawn) for key, value in named.items()}
        return ScoredRow(name, control, 2, scores)

    rows = with_verdicts([row("albedo", False, 0.7, (0.9, 0.5)), row("majority", True, 0.25, (0.25, 0.25))])
    curve = CurveResult("yaw", "camera yaw", (0.0, 40.0), (8, 8, 16), {"accuracy": rows})
    how = ("identity of generated faces", "classes", ("a", "b"), "logistic", {"yaw": 19}, 3, (0, 1))
    result = RobustnessComparison((curve,), *how)
    area, curve, _ = result.tables()
    assert area.caption == (
        "camera yaw, 0 to 40 degrees: accuracy of 2 classes, identity of generated faces; logistic probes on "
        "19 images, 8 to 16 tested, 2 seeds; 3 images without label left out"
    )
    cells = area.values()["albedo"]
    shown = [round(float(cells[name]), 3) for name in ("area", "ordinary", "at 40 deg", "lost")]
    assert shown == [0.7, 0.9, 0.5, 0.2]
    assert area.best(0) == cells["area"] and area.best(5) is None  # to lose nothing is no merit by itself
    assert [row.control for row in area.rows] == [False, True]
    assert list(curve.values()["majority"]) == ["0", "40"]
