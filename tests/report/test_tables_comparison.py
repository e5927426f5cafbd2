"""Tables made of comparisons say what the comparison found, and stand beside the paper's lines."""

import numpy as np

from derender.evaluation import compare_clusterings
from derender.evaluation.clustering_levels import finch_levels
from derender.evaluation.linear_compare import compare_linear
from derender.evaluation.linear_task import choose_rows, task_of
from derender.evaluation.score_table import verdict, verdict_table
from derender.evaluation.tables import EMOTION, LINEAR
from derender.report.tables_comparison import (
    CLUSTER_COLUMNS,
    LINEAR_COLUMNS,
    cluster_comparison_table,
    finch_table,
    linear_part_table,
    paper_cluster_table,
    paper_linear_table,
)

WHO = np.arange(60) % 3
FEATURES = {
    "ours": [np.eye(3)[WHO] + 0.01 * np.random.default_rng(0).normal(size=(60, 3))],
    "noise": [np.random.default_rng(seed).normal(size=(60, 3)) for seed in range(2)],
}


def test_a_clustering_table_shows_scores_intervals_and_spread():
    labels = np.where(WHO == 0, np.nan, WHO)
    labels[:3] = 0
    found = compare_clusterings(FEATURES, {"who": labels}, controls=("noise",), resample_count=50)
    table = cluster_comparison_table(found)
    names = [column.name for column in table.columns]
    assert names == ["accuracy", "95 %", "±", "F1", "NMI", "matched", "ARI"]
    assert "41 rows, 3 classes of who" in table.caption
    assert "19 rows without label left out" in table.caption
    values = table.values()
    assert values["ours"]["accuracy"] == found.rows[0].scores["accuracy"].value
    assert np.isnan(values["ours"]["±"]) and values["noise"]["±"] > 0
    assert (
        np.isnan(values["chance"]["95 %"].low) and values["noise"]["95 %"].low < values["noise"]["accuracy"]
    )
    assert [row.control for row in table.rows] == [False, True, True, True]


def test_verdicts_name_the_strongest_control():
    found = compare_clusterings(FEATURES, {"who": WHO}, controls=("noise",), resample_count=50)
    table = verdict_table(found.rows, CLUSTER_COLUMNS, "above?")
    assert [row.name for row in table.rows] == [f"ours: {c.name}" for c in CLUSTER_COLUMNS.values()]
    rival = found.rows[0].versus["accuracy"].rival
    assert table.values()["ours: accuracy"]["strongest control"] == rival
    assert table.values()["ours: accuracy"]["above"] == "yes"
    assert f"above the strongest control ({rival})" in verdict(found.rows[0], "accuracy")
    assert verdict(found.rows[1], "nmi").startswith("noise: 0.")
    same = compare_clusterings(
        {"ours": FEATURES["noise"][:1], "noise": FEATURES["noise"][:1]},
        {"who": WHO}, controls=("noise",), resample_count=50,
    )  # fmt: skip
    assert "not distinguished from" in verdict(same.rows[0], "ari") or "below" in verdict(same.rows[0], "ari")


def test_the_papers_lines_stand_below_ours():
    found = compare_clusterings(FEATURES, {"who": WHO}, controls=("noise",), resample_count=50)
    table = paper_cluster_table("emotion", 1, EMOTION.paper, found, "stand-in: made up")
    values = table.values()
    assert values["paper: Ours - LOOCC-L"] == {
        "accuracy": 0.4058, "F1": 0.3014, "95 %": None, "data": "RAF-DB"
    }  # fmt: skip
    assert values["ours"]["data"] == "stand-in: made up" and "Table 1" in table.caption


def test_linear_tables_and_the_papers():
    task = task_of({"a": (WHO == 0).astype(np.int8)})
    rows = choose_rows(task, [str(row) for row in range(60)], (10, 20), (0, 1))
    found = compare_linear(
        FEATURES, task, rows, (0, 1), controls=("noise",), heads=("linear", "k-NN"), resample_count=50
    )
    part = linear_part_table(found, found.parts[0])
    assert "10 labelled rows, the paper's head, frozen features: 30 rows tested" in part.caption
    assert [column.name for column in part.columns] == ["accuracy", "95 %", "±", "balanced", "AP"]
    judged = verdict_table(found.parts[0].rows, LINEAR_COLUMNS, "above?")
    assert [row.name for row in judged.rows] == ["ours: accuracy", "ours: balanced"]
    table = paper_linear_table("attributes", 2, LINEAR.paper, found, "subset")
    assert [column.name for column in table.columns] == ["10 frozen", "20 frozen", "data"]
    assert not any(row.note for row in table.rows)  # the paper has no numbers for 10 and 20 labels
    wide = compare_linear(
        {"ours": [np.repeat(FEATURES["ours"][0], 4, axis=0)]},
        wide_task := task_of({"a": np.repeat(WHO == 0, 4).astype(np.int8)}),
        choose_rows(wide_task, [str(row) for row in range(240)], (100,), (0, 1)),
        (0, 1), heads=("linear",), resample_count=20,
    )  # fmt: skip
    values = paper_linear_table("attributes", 2, LINEAR.paper, wide, "subset").values()
    assert values["paper: Ours - LOOCC-LV"] == {"100 frozen": 0.8226, "data": "CelebA"}
    assert "paper: Supervised ResNet-18" not in values  # it has no frozen head


def test_finch_levels_are_shown_beside_chance():
    levels = finch_levels(FEATURES["ours"][0], WHO)
    table = finch_table("ours", levels, 3)
    assert [row.name for row in table.rows] == [f"{level.clusters} clusters" for level in levels]
    assert table.rows[0].cells[0] > table.rows[0].cells[1]
