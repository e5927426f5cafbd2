"""Comparisons of features by clustering: known answers, chance, controls, missing labels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score, normalized_mutual_info_score

from derender.evaluation import compare_clusterings, evaluate_clustering
from derender.evaluation.clustering_compare import SCORES
from derender.evaluation.clustering_scores import scores_of_counts

NAMES = np.array(["ann", "bob", "cid"])


def problem(rows: int = 90, spread: float = 0.1):
    rng = np.random.default_rng(0)
    labels = np.arange(rows) % 3
    return {
        "ours": [np.eye(3)[labels] + spread * rng.normal(size=(rows, 3))],
        "noise": [rng.normal(size=(rows, 3)) for _ in range(3)],
    }, NAMES[labels]


def compare(features, labels, **options):
    return compare_clusterings(features, labels, controls=("noise",), resample_count=200, **options)


def test_true_groups_win_and_say_so():
    features, who = problem()
    found = compare(features, {"who": who})
    rows = {row.name: row for row in found.rows}
    assert list(rows) == ["ours", "noise", "majority", "chance"]
    assert [row.control for row in found.rows] == [False, True, True, True]
    ours = rows["ours"]
    assert all(ours.scores[score].value == pytest.approx(1) for score in SCORES)
    assert all(one.above for one in ours.versus.values())
    assert rows["noise"].runs == 3 and rows["noise"].scores["accuracy"].spread > 0
    assert rows["majority"].scores["accuracy"].value == pytest.approx(1 / 3)
    assert rows["majority"].scores["nmi"].value == rows["majority"].scores["ari"].value == 0
    assert abs(rows["chance"].scores["ari"].value) < 0.03
    assert (found.n_rows, found.n_dropped, found.labels) == (90, 0, {"who": 3})


def test_it_agrees_with_the_protocol_for_one_label():
    features, who = problem(spread=0.6)
    found = compare(features, {"who": who}).rows[0].scores
    alone = evaluate_clustering(features["ours"][0], who).scores
    for score in SCORES:
        assert found[score].value == pytest.approx(getattr(alone, score))
        assert found[score].low <= found[score].value <= found[score].high


def test_shuffled_labels_are_not_above_the_controls():
    features, who = problem()
    shuffled = np.random.default_rng(1).permutation(who)
    ours = compare(features, {"who": shuffled}).rows[0]
    assert not any(ours.versus[score].above for score in ("accuracy", "nmi", "ari", "hungarian"))


def test_several_labels_are_the_mean_of_each_alone():
    features, who = problem(spread=0.6)
    attributes = {"a": (who == "ann").astype(np.int8), "b": np.arange(90) % 2 == 0}
    both = compare(features, attributes)
    for score in SCORES:
        alone = [compare(features, {name: v}).rows[0].scores[score].value for name, v in attributes.items()]
        assert both.rows[0].scores[score].value == pytest.approx(np.mean(alone))
    assert both.labels == {"a": 2, "b": 2} and set(both.per_label["ours"]) == {"a", "b"}


def test_missing_labels_are_dropped_and_counted():
    features, who = problem()
    column = who.astype(object)
    column[[0, 1]] = None
    found = compare(features, {"who": column})
    assert (found.n_rows, found.n_dropped, found.n_missing) == (88, 2, 0)
    other = np.arange(90) % 2
    both = compare(features, {"who": column, "other": other})
    assert (both.n_rows, both.n_dropped, both.n_missing) == (90, 0, 2)
    assert both.rows[0].scores["accuracy"].value == pytest.approx(
        (1 + evaluate_clustering(features["ours"][0], other).scores.accuracy) / 2
    )


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(30)), st.permutations(range(3)))
def test_order_of_rows_and_names_of_classes_do_not_matter(order, names):
    features, who = problem(30, spread=0.7)
    order = np.array(order)
    straight = compare(features, {"who": who}).rows[0].scores
    moved = {name: [array[order] for array in arrays] for name, arrays in features.items()}
    renamed = NAMES[list(names)][np.searchsorted(NAMES, who)][order]
    other = compare(moved, {"who": renamed}).rows[0].scores
    for score in ("accuracy", "nmi", "hungarian", "ari"):
        assert other[score].value == pytest.approx(straight[score].value)


def test_scores_of_many_tables_at_once_are_those_of_each():
    rng = np.random.default_rng(0)
    tables = rng.integers(0, 6, size=(40, 3, 4))
    tables[0] = np.diag([5, 5, 5, 0])[:3]
    tables[1] = 0
    tables[1, 0, 0] = 4
    together = scores_of_counts(tables)
    for table, scores in zip(tables, together, strict=True):
        np.testing.assert_allclose(scores, scores_of_counts(table[None])[0])
        classes, clusters = (np.repeat(index, table.ravel()) for index in np.divmod(np.arange(12), 4))
        assert scores[2] == pytest.approx(normalized_mutual_info_score(classes, clusters))
        assert scores[4] == pytest.approx(adjusted_rand_score(classes, clusters))


def test_k_means_is_run_with_five_seeds():
    features, who = problem()
    found = compare({"ours": features["ours"]}, {"who": who}, method="k-means")
    assert found.rows[0].runs == 5 and found.rows[0].scores["accuracy"].value == pytest.approx(1)


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        ({"who": np.zeros(90)}, {}, "two classes, the 90 labelled rows of 'who' have 1"),
        ({"who": np.full(90, "")}, {}, "two classes, the 0 labelled rows of 'who' have 0"),
        ({"who": np.arange(90) % 2}, {"n_clusters": 91}, "cannot make 91 clusters of 90 rows"),
        ({"who": np.arange(89) % 2}, {}, "features 'ours' has 90 rows, the others 89"),
        ({}, {}, "at least one label"),
    ],
)
def test_bad_input_is_refused_in_words(labels, options, message):
    with pytest.raises(ValueError, match=message):
        compare(problem()[0], labels, **options)
