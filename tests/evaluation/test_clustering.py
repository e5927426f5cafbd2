"""Clustering scores against oracles and closed forms; the protocol on data against known numbers."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import AgglomerativeClustering
from sklearn.metrics import adjusted_rand_score, f1_score, normalized_mutual_info_score

from derender.baselines.controls import pca_features, pixel_features
from derender.data import read_pictures
from derender.evaluation import (
    at_least,
    chance_scores,
    cluster_scores,
    cluster_table,
    evaluate_clustering,
    ward,
)
from derender.evaluation.clustering_ward import cut, ward_tree
from derender.features import FeatureTable

SCORES = ("accuracy", "f1", "nmi", "hungarian", "ari")


def blobs(classes: int = 4, each: int = 12, spread: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(classes), each)
    return 3 * np.eye(classes)[labels] + spread * rng.normal(size=(len(labels), classes)), labels


@st.composite
def labelled_clusters(draw):
    rows = draw(st.integers(2, 30))
    labels = draw(st.lists(st.integers(0, 4), min_size=rows, max_size=rows))
    clusters = draw(st.lists(st.integers(0, 3), min_size=rows, max_size=rows))
    return np.array(labels), np.array(clusters)


@settings(max_examples=40, deadline=None)
@given(labelled_clusters())
def test_scores_agree_with_their_definitions_written_out(case):
    labels, clusters = case
    scores = cluster_scores(labels, clusters)
    majority = np.empty_like(labels)
    for cluster in np.unique(clusters):
        majority[clusters == cluster] = np.bincount(labels[clusters == cluster]).argmax()
    assert scores.accuracy == pytest.approx((majority == labels).mean())
    assert scores.f1 == pytest.approx(f1_score(labels, majority, average="weighted", zero_division=0))
    assert scores.nmi == pytest.approx(normalized_mutual_info_score(labels, clusters))
    assert scores.ari == pytest.approx(adjusted_rand_score(labels, clusters))
    best = max(
        sum((labels == names[c]) & (clusters == c) for c in range(4)).sum()
        for names in permutations(range(5), 4)
    )
    assert scores.hungarian == pytest.approx(best / len(labels))
    assert scores.hungarian <= scores.accuracy + 1e-12


@settings(max_examples=40, deadline=None)
@given(labelled_clusters(), st.permutations(range(4)), st.permutations(range(5)))
def test_names_of_clusters_and_classes_do_not_matter(case, cluster_names, class_names):
    labels, clusters = case
    scores = cluster_scores(labels, clusters)
    renamed = cluster_scores(
        np.array(list("abcde"))[list(class_names)][labels], np.array(cluster_names)[clusters] * 7 - 3
    )
    for name in ("accuracy", "nmi", "hungarian", "ari"):
        assert getattr(renamed, name) == pytest.approx(getattr(scores, name))


def test_true_classes_score_the_best_value_and_one_cluster_the_majority():
    labels = np.array(["a"] * 6 + ["b"] * 3 + ["c"])
    best = cluster_scores(labels, np.array([2] * 6 + [0] * 3 + [1]))
    assert [getattr(best, name) for name in SCORES] == pytest.approx([1] * 5)
    one = cluster_scores(labels, np.zeros(10, int))
    assert one.accuracy == one.hungarian == 0.6 and one.nmi == 0 and one.ari == 0
    assert one.f1 == pytest.approx(0.6 * (2 * 0.6 / 1.6))


def test_ward_agrees_with_scikit_learn_at_every_cut():
    features = np.random.default_rng(1).normal(size=(40, 5))
    tree = ward_tree(features)
    for n_clusters in range(1, 41):
        ours = cut(tree, n_clusters)
        theirs = AgglomerativeClustering(n_clusters, linkage="ward").fit_predict(features)
        assert len(np.unique(ours)) == n_clusters and ours[0] == 0
        assert adjusted_rand_score(ours, theirs) == 1


def test_identical_rows_still_give_the_number_of_clusters_asked_for():
    assert len(np.unique(ward(np.zeros((9, 2)), 4))) == 4


def test_separated_blobs_are_found_and_shuffled_labels_score_chance():
    features, labels = blobs()
    result = evaluate_clustering(features, labels)
    assert result.scores.accuracy == result.scores.nmi == result.scores.f1 == 1
    assert (result.n_rows, result.n_classes, result.n_clusters, result.n_dropped) == (48, 4, 4, 0)
    assert result.majority == 0.25
    shuffled = evaluate_clustering(features, np.random.default_rng(5).permutation(labels), seeds=range(50))
    for name in SCORES:
        chance, spread = getattr(shuffled.chance, name), getattr(shuffled.chance_spread, name)
        assert abs(getattr(shuffled.scores, name) - chance) < 4 * spread
    assert abs(shuffled.chance.ari) < 0.02 and shuffled.chance.accuracy > 0.3


def test_chance_keeps_cluster_sizes_and_needs_a_seed():
    labels = np.array([0] * 90 + [1] * 10)
    one_big = chance_scores(labels, np.array([0] * 99 + [1]), seeds=range(5))[0]
    assert one_big.accuracy == pytest.approx(0.9)
    equal, spread = chance_scores(np.arange(100) % 2, 50, seeds=range(20))
    assert equal.accuracy == pytest.approx(0.75, abs=0.04) and spread.accuracy > 0
    with pytest.raises(ValueError, match="at least one seed"):
        chance_scores(labels, labels, seeds=())


def test_missing_labels_are_dropped_and_counted():
    features, labels = blobs()
    names = np.array(list("abcd"), dtype=object)[labels]
    names[[0, 13]] = None
    names[30] = ""
    result = evaluate_clustering(np.vstack([features, np.full((1, 4), 99.0)]), np.append(names, None))
    assert result.n_dropped == 4 and result.n_rows == 45 and result.scores.accuracy == 1


@pytest.mark.parametrize(
    ("features", "labels", "n_clusters", "message"),
    [
        (np.ones((3, 2)), ["a"] * 3, None, "at least two classes, the 3 labelled rows have 1"),
        (np.ones((3, 2)), ["", "", ""], None, "at least two classes, the 0 labelled rows have 0"),
        (np.ones((3, 2)), ["a", "b", "b"], 4, "cannot make 4 clusters of 3 rows: ask for 1 to 3"),
        (np.ones((3, 2)), ["a", "b", "b"], 0, "cannot make 0 clusters"),
        (np.array([[1.0], [np.nan], [2.0]]), ["a", "b", "b"], None, "not finite in 1 of 3 rows"),
        (np.ones((3, 2)), ["a", "b"], None, "3 rows of features but 2 labels"),
        (np.ones(3), ["a", "b", "b"], None, r"must be \(rows, dimensions\), got shape \(3,\)"),
        (np.ones((3, 2)), [["a"], ["b"], ["b"]], None, "one value per row"),
    ],
)
def test_bad_input_is_refused_in_words(features, labels, n_clusters, message):
    with pytest.raises(ValueError, match=message):
        evaluate_clustering(features, np.array(labels), n_clusters)


def test_scores_need_rows_labels_and_one_length():
    with pytest.raises(ValueError, match="no rows"):
        cluster_scores(np.array([]), np.array([]))
    with pytest.raises(ValueError, match="1 labels are missing"):
        cluster_scores(np.array(["a", ""]), np.array([0, 1]))
    with pytest.raises(ValueError, match="must be of one length"):
        cluster_scores(np.array(["a", "b"]), np.array([0, 1, 2]))


def test_a_class_with_one_member_is_a_class():
    result = evaluate_clustering(np.array([[0.0], [0.1], [9.0]]), np.array(["a", "a", "b"]))
    assert result.n_classes == 2 and result.scores.accuracy == 1


def test_at_least_keeps_big_classes_and_their_first_members():
    labels = np.array(list("abacab") + [""] * 3)
    assert at_least(labels, 2).tolist() == [0, 1, 2, 4, 5]
    assert at_least(labels, 3).tolist() == [0, 2, 4]
    assert at_least(labels, 2, most=2).tolist() == [0, 1, 2, 5]
    with pytest.raises(ValueError, match=r"no class has 4 members or more \(the largest has 3\)"):
        at_least(labels, 4)


def test_a_table_is_averaged_capped_and_clustered():
    features, labels = blobs(3, 20)
    tracks = np.arange(60) // 5
    noise = np.random.default_rng(0).normal(size=(60, 3)) * 30
    noise -= np.repeat(noise.reshape(12, 5, 3).mean(1), 5, axis=0)
    who = np.array(["ann", "bob", "cid"])[labels]
    who[7] = ""
    table = FeatureTable(
        tuple(map(str, range(60))),
        {"geometry": features + noise, "junk": noise},
        {"who": who, "track": tracks},
    )
    assert cluster_table(table, "who", factors=("geometry",)).scores.accuracy < 0.9
    table = table.select(np.flatnonzero(tracks != 1))
    means = cluster_table(table, "who", factors=("geometry",), mean_by=("track",))
    assert means.scores.accuracy == 1 and means.n_rows == 11
    capped = cluster_table(table, "who", factors="geometry", min_count=16, max_count=4)
    assert (capped.n_rows, capped.n_classes) == (8, 2)
    with pytest.raises(ValueError, match="label 'track' differs inside groups of who: average by it too"):
        cluster_table(table, "track", mean_by=("who",))
    with pytest.raises(ValueError, match="unknown label 'wo'; did you mean 'who'"):
        cluster_table(table, "wo", factors=None)


def test_missing_labels_are_counted_before_averaging():
    features, labels = blobs(2, 10)
    who = np.array(["a", "b"])[labels]
    who[3] = ""
    table = FeatureTable(
        tuple(map(str, range(20))), {"f": features}, {"who": who, "track": np.arange(20) // 2}
    )
    result = cluster_table(table, "who", factors=None, mean_by=("track",))
    assert result.n_dropped == 1 and result.n_rows == 10


def test_pixels_on_lfw_reach_what_is_known(shared_data):
    """31 people, 20 pictures each: 0.24 by pixels, 0.13 by chance."""
    pictures = read_pictures(shared_data("data/lfw64.zip"), 64)
    pictures = pictures.select(at_least(pictures.labels["identity"], 20, most=20))
    assert len(pictures) == 620
    pixels = cluster_table(pixel_features(pictures), "identity", factors=None)
    assert pixels.n_classes == 31
    assert pixels.scores.accuracy == pytest.approx(0.237, abs=0.01)
    assert pixels.chance.accuracy == pytest.approx(0.13, abs=0.01)


def test_pixels_on_tracks_reach_what_is_known(shared_data):
    """240 tracks of 12 rendered people: 0.23 by pixels; PCA is no better."""
    pictures = read_pictures(shared_data("data/synface_tracks64.zip"), 64)
    options = {"factors": None, "mean_by": ("identity", "track")}
    pixels = cluster_table(pixel_features(pictures), "identity", **options)
    assert (pixels.n_rows, pixels.n_classes) == (240, 12)
    assert pixels.scores.accuracy == pytest.approx(0.225, abs=0.01)
    assert pixels.majority == pytest.approx(1 / 12)
    assert pixels.chance.accuracy == pytest.approx(0.195, abs=0.01)
    assert cluster_table(pca_features(pictures), "identity", **options).scores.accuracy < 0.24
