"""Pearson, CKA and cross-prediction: NumPy and kernels written out as oracles, chance, what is left out."""

import numpy as np
import pytest
from sklearn.linear_model import Ridge

from derender.evaluation.disentanglement import correlation_matrix, linear_cka, pearson, similarity
from derender.evaluation.disentanglement.similarity import CAUTION, PENALTIES, fit_predict, held_out


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
    with pytest.raises(ValueError, match="factor 'b' is not finite in 6 of 6 rows, first in row 0"):
        score({"a": np.ones((6, 2)), "b": np.full((6, 2), np.inf)})
    blocks = features()
    with pytest.raises(ValueError, match=r"two or more of one number of rows.*got 1 features of \[40\]"):
        score({"a": blocks["light"]})
    with pytest.raises(ValueError, match=r"got 4 features of \[39, 40\] rows"):
        score(blocks | {"light": blocks["light"][1:]})


def normal(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def hsic_by_kernels(x: np.ndarray, y: np.ndarray, unbiased: bool) -> float:
    """HSIC from N x N kernels, term by term as published."""
    n = len(x)
    k, m = x @ x.T, y @ y.T
    if not unbiased:
        centre = np.eye(n) - 1 / n
        return np.trace(centre @ k @ centre @ m)
    np.fill_diagonal(k, 0)
    np.fill_diagonal(m, 0)
    middle = k.sum() * m.sum() / ((n - 1) * (n - 2))
    return (np.trace(k @ m) + middle - 2 / (n - 2) * (k @ m).sum()) / (n * (n - 3))


@pytest.mark.parametrize("unbiased", [False, True])
def test_cka_is_what_the_kernels_give(unbiased):
    x, y = normal(30, 7), normal(30, 12, seed=1) + 2
    y[:, :3] += x[:, :3]
    cross, own_x, own_y = (hsic_by_kernels(*pair, unbiased) for pair in ((x, y), (x, x), (y, y)))
    assert linear_cka(x, y, unbiased=unbiased) == pytest.approx(cross / np.sqrt(own_x * own_y), rel=1e-9)


def test_only_the_unbiased_form_is_zero_by_chance():
    x, y = normal(200, 128), normal(200, 128, seed=1)
    assert linear_cka(x, y, unbiased=False) > 0.3
    assert abs(linear_cka(x, y, unbiased=True)) < 0.02


def test_a_linear_map_is_predicted_and_constant_features_predict_the_reference():
    x = normal(200, 10)
    y = x @ normal(10, 4, seed=1) + 3
    predicted, reference = held_out(x, y)
    np.testing.assert_allclose(predicted, y, atol=1e-3)
    for train_mean in np.unique(reference, axis=0):
        rows = (reference == train_mean).all(axis=1)
        assert rows.sum() == 40 and y[~rows].mean(axis=0) == pytest.approx(train_mean)
    constant, reference = held_out(np.ones((200, 3)), y, seed=4)
    np.testing.assert_allclose(constant, reference, rtol=1e-12)


@pytest.mark.parametrize("width", [6, 30, 90])
def test_ridge_regression_is_that_of_scikit_learn_with_the_penalty_of_each_target(width):
    draw = np.random.default_rng(0)
    x, x_new = draw.normal(size=(50, width)) * np.linspace(0.1, 3, width), draw.normal(size=(9, width))
    y = x[:, :4] @ draw.normal(size=(4, 20)) + draw.normal(size=(50, 20))
    power = np.linalg.svd(x - x.mean(axis=0), compute_uv=False) ** 2
    fits = [Ridge(penalty).fit(x, y) for penalty in np.array(PENALTIES) * power[power > 1e-9].mean()]
    left = [max(50 - CAUTION * (1 + (power / (power + fit.alpha)).sum()), 1e-99) for fit in fits]
    errors = [np.square(fit.predict(x) - y).sum(axis=0) / n**2 for fit, n in zip(fits, left, strict=True)]
    every = np.stack([fit.predict(x_new) for fit in fits])
    theirs = every[np.argmin(errors, axis=0), :, range(20)].T
    np.testing.assert_allclose(fit_predict(x, y, x_new), theirs, atol=1e-7)


def test_cross_prediction_has_a_direction():
    a = normal(150, 6)
    blocks = {"all": a, "part": a[:, :2], "other": normal(150, 6, seed=1)}
    scores = similarity(blocks)
    assert scores.cross_r2[0, 1] == pytest.approx(1, abs=1e-6)
    assert scores.cross_r2[1, 0] == pytest.approx(1 / 3, abs=0.12)
    assert abs(scores.cross_r2[0, 2]) < 0.1 and abs(scores.cka_unbiased[0, 2]) < 0.1
    np.testing.assert_allclose(np.diag(scores.cka_unbiased), 1)
    rows = np.random.default_rng(0).permutation(150)
    shuffled = similarity(blocks | {"part": a[rows, :2]})
    assert shuffled.cross_r2[0, 1] < 0.05 < scores.mean_cross_r2
    off = ~np.eye(3, dtype=bool)
    assert scores.mean_cka_biased == pytest.approx(scores.cka_biased[off].mean())
