"""Both readings of Pearson: closed forms, NumPy as the oracle, invariances, what is left out."""

import numpy as np
import pytest

from derender.evaluation.disentanglement.similarity import correlation_matrix, pearson, similarity


def features(rows: int = 40, size: int = 6, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.standard_normal((rows, size)) for name in ("geometry", "albedo", "light", "camera")}


def test_both_readings_are_what_numpy_says():
    blocks = features()
    a, b = blocks["geometry"], blocks["light"]
    scores = pearson(blocks)
    by_image = [np.corrcoef(a[i], b[i])[0, 1] for i in range(len(a))]
    assert scores.per_image[0, 2] == pytest.approx(np.mean(by_image))
    by_dimension = [abs(np.corrcoef(a[:, p], b[:, q])[0, 1]) for p in range(6) for q in range(6)]
    assert scores.per_dimension[0, 2] == pytest.approx(np.mean(by_dimension))
    whole = np.abs(np.corrcoef(np.concatenate(list(blocks.values()), axis=1).T))
    np.testing.assert_allclose(correlation_matrix(blocks), whole, atol=1e-12)
    off = ~np.eye(4, dtype=bool)
    assert scores.mean_per_dimension == pytest.approx(scores.per_dimension[off].mean())
    assert scores.mean_per_image == pytest.approx(scores.per_image[off].mean())


def test_dead_dimensions_and_constant_vectors_are_left_out_and_counted():
    blocks = features()
    dead = np.concatenate([blocks["light"], np.full((40, 2), 0.3)], axis=1)
    scores = pearson(blocks | {"light": dead})
    assert scores.n_dead == {"geometry": 0, "albedo": 0, "light": 2, "camera": 0}
    np.testing.assert_allclose(scores.per_dimension, pearson(blocks).per_dimension)
    assert np.isnan(scores.per_image[0, 2]) and np.isfinite(scores.mean_per_image)
    assert np.isnan(correlation_matrix(blocks | {"light": dead})[18]).all()
    a, b = blocks["geometry"].copy(), blocks["albedo"]
    a[3] = 0.7
    by_image = [np.corrcoef(a[i], b[i])[0, 1] for i in range(40) if i != 3]
    assert pearson({"a": a, "b": b}).per_image[0, 1] == pytest.approx(np.mean(by_image))
    collapsed = pearson({"a": np.ones((5, 3)), "b": blocks["albedo"][:5, :3]})
    assert np.isnan(collapsed.mean_per_dimension)


@pytest.mark.parametrize("score", [pearson, similarity, correlation_matrix])
def test_bad_input(score):
    with pytest.raises(ValueError, match="feature 'b': 6 of 6 rows are not finite"):
        score({"a": np.ones((6, 2)), "b": np.full((6, 2), np.inf)})
    blocks = features()
    with pytest.raises(ValueError, match=r"two or more of one number of rows.*got 1 features of \[40\]"):
        score({"a": blocks["light"]})
    with pytest.raises(ValueError, match=r"got 4 features of \[39, 40\] rows"):
        score(blocks | {"light": blocks["light"][1:]})
