"""Clusters and pairs decomposed by factor: sums, known answers, invariances."""

import numpy as np
import pytest

from derender.interpretation import cluster_shares, pair_parts

N = 60


@pytest.fixture
def features() -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    return {name: generator.standard_normal((N, 3)) for name in ("geometry", "albedo", "light")}


@pytest.fixture
def clusters() -> np.ndarray:
    return np.repeat(["x", "y", "z"], 20)


def test_a_cluster_made_by_one_factor_says_so(features, clusters):
    features["albedo"][clusters == "x"] += 10
    result = cluster_shares(features, clusters)
    assert result.names == ("x", "y", "z") and result.sizes.tolist() == [20, 20, 20]
    np.testing.assert_allclose(result.share.sum(axis=1), 1)
    assert result.share[0, 1] > 0.99 and result.ratio[0, 1] > 0.9
    assert np.abs(result.ratio[0, [0, 2]] - result.chance[0, [0, 2]]).max() < 0.1


def test_shares_are_those_of_the_distance_between_means(features, clusters):
    result = cluster_shares(features, clusters)
    inside = clusters == "y"
    parts = [((v[inside].mean(axis=0) - v[~inside].mean(axis=0)) ** 2).sum() for v in features.values()]
    np.testing.assert_allclose(result.share[1], np.array(parts) / sum(parts))
    within = features["light"].copy()
    within[inside] -= within[inside].mean(axis=0)
    within[~inside] -= within[~inside].mean(axis=0)
    total = ((features["light"] - features["light"].mean(axis=0)) ** 2).sum()
    assert result.ratio[1, 2] == pytest.approx(1 - (within**2).sum() / total)


def test_parts_of_a_pair_sum_to_distance_and_cosine(features):
    result = pair_parts(features, 4, 7)
    whole = np.concatenate(list(features.values()), axis=1)
    assert result.distance.sum() == pytest.approx(((whole[4] - whole[7]) ** 2).sum())
    assert result.distance_share.sum() == pytest.approx(1)
    cosine = whole[4] @ whole[7] / np.linalg.norm(whole[4]) / np.linalg.norm(whole[7])
    assert result.cosine.sum() == pytest.approx(cosine)


def test_the_factor_two_pictures_share_is_named(features):
    features["light"][9] = features["light"][30] * 1.001
    result = pair_parts(features, 9, 30)
    assert result.most_alike == "light" and result.quantile[2] > 0.97
    assert result.own_cosine[2] == pytest.approx(1) and result.distance_share[2] < 0.01
    louder = pair_parts({name: 5 * values for name, values in features.items()}, 9, 30)
    np.testing.assert_allclose(louder.cosine, result.cosine)
    np.testing.assert_allclose(louder.quantile, result.quantile)
    np.testing.assert_allclose(pair_parts(features, 3, 3).distance_share, 0)
