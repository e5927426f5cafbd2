"""Tables of scores say what the numbers say, whichever way these fall."""

import numpy as np
import pytest

from derender.evaluation import (
    GeometryResult,
    GeometryScores,
    ReconstructionResult,
    ReconstructionScores,
    evaluate_clustering,
)
from derender.report.score_table import (
    Column,
    Row,
    ScoreTable,
    clustering_table,
    geometry_table,
    reconstruction_table,
)


def table(ours: float, controls: dict[str, float | None], best="high") -> ScoreTable:
    rows = [Row("ours", [ours]), *(Row(name, [value], True) for name, value in controls.items())]
    return ScoreTable("", "", [Column("score", best)], rows)


TWO = {"pca": 0.5, "pixels": 0.6}
DEPTHS = {"plane": 3.0, "average": 2.0}


@pytest.mark.parametrize(
    ("ours", "controls", "best", "said"),
    [
        (0.9, TWO, "high", "better than every control: 0.900 against 0.600 (pixels)"),
        (0.55, TWO, "high", "behind the strongest control: 0.550 against 0.600 (pixels), but ahead of pca"),
        (0.1, TWO, "high", "behind the strongest control: 0.100 against 0.600 (pixels)"),
        (0.6, TWO, "high", "level with the strongest control: 0.600 (pixels)"),
        (1.0, DEPTHS, "low", "better than every control: 1.000 against 2.000 (average)"),
        (
            2.5,
            DEPTHS,
            "low",
            "behind the strongest control: 2.500 against 2.000 (average), but ahead of plane",
        ),
        (0.0, {"plane": 0.5}, "low", "better than every control: 0.000 against 0.500 (plane)"),
        (0.5, {"missing": None}, "high", "ours: 0.500 (score)"),
    ],
)
def test_verdict_compares(ours, controls, best, said):
    assert table(ours, controls, best).verdict(0) == said


def test_best_ignores_what_is_no_number():
    scores = table(0.2, {"a": float("nan"), "b": None, "c": 0.3})
    assert scores.best(0) == 0.3
    assert table(0.2, {"a": None}).best(0) is None
    assert ScoreTable("", "", [Column("size")], [Row("a", [1]), Row("b", [2])]).best(0) is None


def test_rows_must_fit_the_columns():
    with pytest.raises(ValueError, match="'ours' has 2 cells for 1 columns"):
        ScoreTable("", "", [Column("a")], [Row("ours", [1, 2])])


def test_clustering_table_carries_chance_and_sizes():
    labels = np.repeat(np.arange(4), 6)
    perfect = evaluate_clustering(np.eye(4)[labels] * 9, labels)
    noise = evaluate_clustering(np.random.default_rng(0).standard_normal((24, 3)), labels)
    scores = clustering_table({"ours": perfect, "pixels": noise}, ["pixels"])
    values = scores.values()
    assert values["ours"] == {"accuracy": 1.0, "F1": 1.0, "NMI": 1.0, "matched": 1.0, "ARI": 1.0}
    assert list(values) == ["ours", "pixels", "chance"]
    assert values["chance"]["accuracy"] == perfect.chance.accuracy < 0.7
    assert [row.control for row in scores.rows] == [False, True, True]
    assert "24 rows, 4 classes, 4 clusters" in scores.caption and "0.250" in scores.caption


def test_geometry_and_reconstruction_tables_print_in_the_papers_units():
    each = np.zeros(2)

    def scores(side: float) -> GeometryScores:
        return GeometryScores(side, 1000 * side, 1.0, 0, each, each)

    found = geometry_table(GeometryResult(scores(0.01), scores(0.02), scores(0.03), None), 2).values()
    assert found["model"] == {"SIDE x 100": 1.0, "MAD": 10.0, "coverage": 1.0}
    assert list(found) == ["model", "average depth", "plane"]
    with_untrained = GeometryResult(scores(0.01), scores(0.02), scores(0.03), scores(0.04))
    assert list(geometry_table(with_untrained, 2).values())[-1] == "untrained model"
    both = [ReconstructionScores(l1, 20.0, 0.9, 0, each, each, 0.5, each) for l1 in (0.05, 0.1)]
    assert "better than every control" in reconstruction_table(ReconstructionResult(*both), 2).verdict(0)
