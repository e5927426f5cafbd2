"""Clustering scores against oracles and closed forms; comparisons of features; the protocol on known data."""

from collections import Counter
from itertools import permutations
from pathlib import PurePath
from zipfile import ZipFile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score, f1_score, normalized_mutual_info_score

from derender.baselines.controls import pixel_features
from derender.data import read_images
from derender.evaluation import chance_scores, cluster, cluster_scores, compare_clusterings
from derender.evaluation.clustering import clustering_tables
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS, METRICS, metric
from derender.evaluation.feature_rows import at_least
from derender.evaluation.score_table import verdict
from derender.features import FeatureTable

NAMES = np.array(["ann", "bob", "cid"])


def problem(rows: int = 90, spread: float = 0.1):
    rng = np.random.default_rng(0)
    labels = np.arange(rows) % 3
    return {
        "ours": [np.eye(3)[labels] + spread * rng.normal(size=(rows, 3))],
        "noise": [rng.normal(size=(rows, 3)) for _ in range(3)],
    }, NAMES[labels]


def compare(features, labels, **options):
    return compare_clusterings(features, labels, controls=("noise",), resample_count=50, **options)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 3)), min_size=2, max_size=30))
def test_scores_agree_with_their_definitions_written_out(rows):
    labels, clusters = np.array(rows).T
    scores = cluster_scores(labels, clusters)
    majority = np.empty_like(labels)
    for one in np.unique(clusters):
        majority[clusters == one] = np.bincount(labels[clusters == one]).argmax()
    assert scores["accuracy"] == pytest.approx((majority == labels).mean())
    assert scores["f1"] == pytest.approx(f1_score(labels, majority, average="weighted", zero_division=0))
    assert scores["nmi"] == pytest.approx(normalized_mutual_info_score(labels, clusters))
    assert scores["ari"] == pytest.approx(adjusted_rand_score(labels, clusters))
    named = permutations(range(5), 4)
    best = max(sum((labels == names[c]) & (clusters == c) for c in range(4)).sum() for names in named)
    assert scores["hungarian"] == pytest.approx(best / len(labels))
    assert scores["hungarian"] <= scores["accuracy"] + 1e-12


def test_true_classes_score_the_best_value_and_one_cluster_the_majority():
    labels = np.array(["a"] * 6 + ["b"] * 3 + ["c"])
    assert list(cluster_scores(labels, np.array([2] * 6 + [0] * 3 + [1])).values()) == pytest.approx([1] * 5)
    one = cluster_scores(labels, np.zeros(10, int))
    assert one["accuracy"] == one["hungarian"] == 0.6 and one["nmi"] == one["ari"] == 0
    assert one["f1"] == pytest.approx(0.6 * (2 * 0.6 / 1.6))


def test_chance_keeps_cluster_sizes_and_needs_a_seed():
    labels = np.array([0] * 90 + [1] * 10)
    one_big = chance_scores(labels, np.array([0] * 99 + [1]), seeds=range(5))
    assert one_big["accuracy"] == pytest.approx(0.9)
    assert chance_scores(np.arange(100) % 2, 50, seeds=range(20))["accuracy"] == pytest.approx(0.75, abs=0.04)
    with pytest.raises(ValueError, match="at least one seed"):
        chance_scores(labels, labels, seeds=())


@pytest.mark.parametrize(
    ("labels", "clusters", "message"),
    [([], [], "no rows"), (["a", ""], [0, 1], "1 labels are missing"),
     (["a", "b"], [0, 1, 2], "must be of one length"), ([["a"], ["b"]], [0, 1], "one value per row")],
)  # fmt: skip
def test_scores_need_rows_labels_and_one_length(labels, clusters, message):
    with pytest.raises(ValueError, match=message):
        cluster_scores(np.array(labels), np.array(clusters))


def test_at_least_keeps_big_classes_and_their_first_members():
    labels = np.array(list("abacab") + [""] * 3)
    assert at_least(labels, 2).tolist() == [0, 1, 2, 4, 5]
    assert at_least(labels, 3).tolist() == [0, 2, 4]
    assert at_least(labels, 2, most=2).tolist() == [0, 1, 2, 5]
    with pytest.raises(ValueError, match=r"no class has 4 members or more \(the largest has 3\)"):
        at_least(labels, 4)


def test_true_groups_win_and_say_so():
    features, who = problem()
    result = compare(features, {"who": who})
    rows = {row.name: row for row in result.rows}
    assert list(rows) == ["ours", "noise", "majority", "chance"]
    assert [row.control for row in result.rows] == [False, True, True, True]
    ours = rows["ours"]
    assert all(ours.scores[score].value == pytest.approx(1) for score in METRICS)
    assert all(one.above for one in ours.versus.values())
    assert rows["noise"].runs == 3 and rows["noise"].scores["accuracy"].deviation > 0
    assert rows["majority"].scores["accuracy"].value == pytest.approx(1 / 3)
    assert rows["majority"].scores["nmi"].value == rows["majority"].scores["ari"].value == 0
    assert abs(rows["chance"].scores["ari"].value) < 0.03
    assert (result.n_rows, result.n_dropped, result.labels) == (90, 0, {"who": 3})


def test_intervals_hold_the_value_and_shuffled_labels_are_at_chance():
    features, who = problem(spread=0.6)
    ours = compare(features, {"who": who}).rows[0]
    assert all(one.low <= one.value <= one.high for one in ours.scores.values())
    shuffled = compare(features, {"who": np.random.default_rng(1).permutation(who)})
    assert not any(shuffled.rows[0].versus[score].above for score in ("accuracy", "nmi", "ari", "hungarian"))
    chance = shuffled.rows[-1].scores
    for name in METRICS:
        assert abs(shuffled.rows[0].scores[name].value - chance[name].value) < 4 * chance[name].deviation


def test_several_labels_are_the_mean_of_each_alone():
    features, who = problem(spread=0.6)
    attributes = {"a": (who == "ann").astype(np.int8), "b": np.arange(90) % 2 == 0}
    both = compare(features, attributes)
    for score in METRICS:
        alone = [compare(features, {name: v}).rows[0].scores[score].value for name, v in attributes.items()]
        assert both.rows[0].scores[score].value == pytest.approx(np.mean(alone))
    assert both.labels == {"a": 2, "b": 2} and set(both.per_label["ours"]) == {"a", "b"}


def test_missing_labels_are_dropped_and_counted():
    features, who = problem()
    column = who.astype(object)
    column[[0, 1]] = None
    result = compare(features, {"who": column})
    assert (result.n_rows, result.n_dropped, result.n_missing) == (88, 2, 0)
    other = np.arange(90) % 2
    both = compare(features, {"who": column, "other": other})
    assert (both.n_rows, both.n_dropped, both.n_missing) == (90, 0, 2)
    alone = compare(features, {"other": other}).rows[0].scores["accuracy"].value
    assert both.rows[0].scores["accuracy"].value == pytest.approx((1 + alone) / 2)


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        ({"who": np.zeros(90)}, {}, "two classes, the 90 labelled rows of 'who' have 1"),
        ({"who": np.full(90, "")}, {}, "two classes, the 0 labelled rows of 'who' have 0"),
        ({"who": np.arange(90) % 2}, {"n_clusters": 91}, "cannot make 91 clusters of 90 rows"),
        ({"who": np.arange(90) % 2}, {"n_clusters": 0}, "cannot make 0 clusters of 90 rows"),
        ({"who": np.arange(89) % 2}, {}, "features 'ours' have 90 rows, the labels 89"),
        ({"who": np.arange(90)}, {}, "is a class of its own"),
        ({}, {}, "at least one label"),
    ],
)
def test_bad_input_is_refused_in_words(labels, options, message):
    with pytest.raises(ValueError, match=message):
        compare(problem()[0], labels, **options)


def test_tables_show_scores_intervals_and_the_strongest_control():
    features, who = problem()
    column = who.astype(object)
    column[:19] = None
    result = compare(features, {"who": column})
    table, judged = clustering_tables(result, "above?")
    assert [one.name for one in table.columns] == ["accuracy", "95 %", "±", "F1", "NMI", "matched", "ARI"]
    assert table.caption == "Ward clustering: 71 rows, 3 classes of who; 19 rows without label left out"
    values = table.values()
    assert np.isnan(values["ours"]["±"]) and values["noise"]["±"] > 0
    assert np.isnan(values["chance"]["95 %"].low)
    assert values["noise"]["95 %"].low < values["noise"]["accuracy"] < values["noise"]["95 %"].high
    assert [row.name for row in judged.rows] == [f"ours: {c.name}" for c in CLUSTER_COLUMNS.values()]
    rival = result.rows[0].versus["accuracy"].rival
    accuracy, nmi, ari = (CLUSTER_COLUMNS[score] for score in ("accuracy", "nmi", "ari"))
    assert judged.values()["ours: accuracy"]["strongest control"] == rival
    assert judged.values()["ours: accuracy"]["above"] == "yes"
    assert f"better than the strongest control ({rival})" in verdict(result.rows[0], "accuracy", accuracy)
    assert verdict(result.rows[1], "nmi", nmi).startswith("noise: NMI 0.")
    same = compare({"ours": features["noise"], "noise": features["noise"]}, {"who": who}).rows[0]
    assert any(word in verdict(same, "ari", ari) for word in ("not distinguished from", "worse than"))


def test_a_metric_declared_once_is_scored_judged_and_shown(monkeypatch):
    for declared in (METRICS, CLUSTER_COLUMNS):
        monkeypatch.setitem(declared, "rows", None)  # gone after the test

    @metric("rows", "pure rows", "share of rows in clusters of one class")
    def pure_rows(table: np.ndarray) -> np.ndarray:
        pure = (table > 0).sum(axis=1) == 1
        return (table.sum(axis=1) * pure).sum(axis=1) / table.sum(axis=(1, 2))

    features, who = problem()
    result = compare(features, {"who": who})
    assert result.rows[0].scores["rows"].value == 1 and result.rows[0].versus["rows"].above
    table, judged = clustering_tables(result, "above?")
    assert table.values()["ours"]["pure rows"] == 1 and "ours: pure rows" in judged.values()


@pytest.fixture(scope="module")
def tracks() -> FeatureTable:
    """12 tracks of three people; the mean noise of a track is 0, the track with a label missing has none."""
    labels, noise = np.repeat(np.arange(3), 20), np.random.default_rng(0).normal(size=(60, 3)) * 30
    noise -= np.repeat(noise.reshape(12, 5, 3).mean(1), 5, axis=0)
    noise[5:10] = 0
    who = NAMES[labels]
    who[7] = ""
    features = {"geometry": 3 * np.eye(3)[labels] + noise, "junk": noise}
    return FeatureTable(tuple(map(str, range(60))), features, {"who": who, "track": np.arange(60) // 5})


def test_one_call_averages_caps_clusters_and_scores(tracks, tmp_path):
    how = {"factors": ("geometry",), "resamples": 20, "cache": "none"}
    path = tracks.write(tmp_path / "t.parquet")
    plain = cluster(path, "who", **how)
    assert plain.values["rows"]["geometry"]["scores"]["accuracy"]["value"] < 0.9
    assert plain.values["n_dropped"] == 1 and "without images there are no pixels" in plain.notes[0]
    means = cluster(tracks, "who", mean_by=("who", "track"), **how)
    assert means.values["rows"]["geometry"]["scores"]["accuracy"]["value"] == 1
    assert (means.values["n_rows"], means.values["n_dropped_before"]) == (12, 1)
    assert means.to_pandas().loc["geometry", "accuracy"] == 1 and "| geometry |" in means.to_markdown()
    assert cluster(tracks, "who", mean_by="track", **how).values["n_rows"] == 12  # one name, not its letters
    capped = cluster(tracks, "who", min_count=20, max_count=4, **how)
    assert (capped.values["n_rows"], capped.values["labels"]) == (8, {"who": 2})
    assert capped.values["n_dropped"] == len(tracks) - 8
    levels = cluster(tracks, "who", method="finch", mean_by=("who", "track"), **how)
    assert levels.tables[2].caption.startswith("FINCH on geometry") and levels.values["finch"]["geometry"]
    for bad, message in (
        (("wo", {}), "unknown label 'wo'; did you mean 'who'"),
        ((None, {}), "give either label"),
        (("who", {"factors": ("geometri",)}), "unknown factor 'geometri'"),
    ):
        with pytest.raises(ValueError, match=message):
            cluster(tracks, bad[0], **{**how, **bad[1]})
    with pytest.raises(ValueError, match="needs images to embed"):
        cluster("faces-64", "who")


def test_pixels_on_lfw_reach_what_is_known(shared_data, tmp_path):
    """31 people, 20 images each: 0.24 by pixels, 0.13 by chance."""
    with ZipFile(shared_data("data/lfw64.zip")) as whole, ZipFile(tmp_path / "lfw.zip", "w") as few:
        counts = Counter(PurePath(name).parent for name in whole.namelist())
        for at, name in enumerate(whole.namelist()):
            if at < 200 or counts[PurePath(name).parent] >= 20:
                few.writestr(name, whole.read(name))
    pixels = pixel_features(read_images(tmp_path / "lfw.zip", 64))
    how = {"factors": None, "min_count": 20, "max_count": 20, "resamples": 10, "cache": "none"}
    values = cluster(pixels, "identity", **how).values
    own, *_, chance = (row["scores"]["accuracy"]["value"] for row in values["rows"].values())
    assert (values["n_rows"], values["labels"]) == (620, {"identity": 31})
    assert (own, chance) == (pytest.approx(0.237, abs=0.01), pytest.approx(0.13, abs=0.01))
