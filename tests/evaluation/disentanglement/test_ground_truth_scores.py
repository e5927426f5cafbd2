"""DCI, MIG, SAP and R2: best on the true factors, chance on shuffled ones, blind where they should be."""

import numpy as np
import pytest
from sklearn.metrics import mutual_info_score

from derender.evaluation.disentanglement import dci, ground_truth_scores, importance, mutual_information
from derender.evaluation.disentanglement.ground_truth import TrueFactor, true_factors

RNG = np.random.default_rng(0)
ROWS = 600
NUMBERS = RNG.uniform(-1, 1, (ROWS, 4))
CLASSES = RNG.integers(0, 3, ROWS)
YAWS = (("ambient", "light"), ("light yaw", "light"), ("camera yaw", "camera"))
FACTORS = [TrueFactor(name, NUMBERS[:, k], False, (of,)) for k, (name, of) in enumerate(YAWS)]
FACTORS.append(TrueFactor("expression", CLASSES, True, ("geometry",)))


def perfect() -> dict[str, np.ndarray]:
    """Each feature is its own true factors and nothing else."""
    return {"light": NUMBERS[:, :2], "camera": NUMBERS[:, 2:3], "geometry": np.eye(3)[CLASSES]}


def test_the_true_factors_themselves_score_best():
    factors = [TrueFactor(str(k), NUMBERS[:, k], False, (str(k),)) for k in range(3)]
    blocks = {str(k): NUMBERS[:, k : k + 1] for k in range(3)}
    scores = ground_truth_scores(blocks, factors, dimensions="lasso")
    for group in (scores.by_feature, scores.by_dimension):
        assert group is not None
        assert group.disentanglement > 0.97 and group.completeness > 0.97
        assert group.informativeness > 0.999
        assert group.mig > 0.88 and group.sap > 0.98
    assert scores.placed == 1
    np.testing.assert_allclose(scores.score, np.eye(3), atol=0.02)


def test_shuffled_rows_score_chance():
    order = np.random.default_rng(1).permutation(ROWS)
    shuffled = {name: values[order] for name, values in perfect().items()}
    scores = ground_truth_scores(shuffled, FACTORS, dimensions="lasso")
    assert scores.by_feature.informativeness < 0.02 and scores.by_feature.sap < 0.02
    assert scores.by_feature.mig < 0.05 and np.abs(scores.together[:3]).max() < 0.03
    assert scores.together[3] < scores.chance[3] + 0.05
    assert scores.by_dimension is not None and scores.by_dimension.mig < 0.05
    assert scores.by_dimension.sap < 0.02


def test_a_factor_in_the_wrong_feature_is_seen_by_placed_alone():
    blocks = perfect()
    names = ("light", "camera", "geometry")
    wrong = dict(zip(names, (blocks["camera"], blocks["geometry"], blocks["light"]), strict=True))
    right, scores = ground_truth_scores(blocks, FACTORS), ground_truth_scores(wrong, FACTORS)
    assert scores.by_feature.disentanglement == pytest.approx(right.by_feature.disentanglement)
    assert right.placed == 1 and scores.placed == 0


def test_scores_by_feature_do_not_see_scale_order_or_rotation():
    blocks = {name: np.hstack([values, RNG.standard_normal((ROWS, 4))]) for name, values in perfect().items()}
    before = ground_truth_scores(blocks, FACTORS)
    turned = {
        name: 7 * values @ np.linalg.qr(RNG.standard_normal((values.shape[1],) * 2))[0] + 1
        for name, values in blocks.items()
    }
    after = ground_truth_scores(turned, FACTORS)
    np.testing.assert_allclose(after.score, before.score, atol=1e-8)
    for name in ("disentanglement", "completeness", "informativeness", "mig", "sap"):
        assert getattr(after.by_feature, name) == pytest.approx(getattr(before.by_feature, name), abs=1e-8)


def test_importance_finds_the_dimension_and_ignores_a_dead_one():
    codes = np.concatenate([RNG.standard_normal((ROWS, 3)), np.zeros((ROWS, 1))], axis=1)[:200]
    classes = (codes[:, 2] > 0).astype(np.int64)
    factors = [TrueFactor("number", 5 * codes[:, 1], False), TrueFactor("class", classes, True)]
    result = importance(codes, factors)
    np.testing.assert_allclose(result.sum(axis=0), 1)
    assert result[1, 0] > 0.95 and result[2, 1] > 0.9 and (result[3] == 0).all()


def test_dci_of_known_matrices():
    assert dci(np.eye(3)) == pytest.approx((1, 1))
    assert dci(np.ones((2, 3))) == pytest.approx((0, 0), abs=1e-12)
    assert dci(np.zeros((2, 2))) == (0, 0)
    entropy = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75)) / np.log(2)
    weights = np.array([[1.0, 3.0], [0.0, 4.0]])  # rows weigh 4 and 4; columns 1 and 7
    assert dci(weights)[0] == pytest.approx((1 - entropy) / 2 + 1 / 2)
    three = -(3 / 7 * np.log(3 / 7) + 4 / 7 * np.log(4 / 7)) / np.log(2)
    assert dci(weights)[1] == pytest.approx(1 / 8 + 7 / 8 * (1 - three))


def test_mutual_information_is_scikit_learns():
    a, b = RNG.integers(0, 5, (300, 3)), RNG.integers(0, 4, 300)
    a[:, 1] = b
    expected = [mutual_info_score(column, b) for column in a.T]
    np.testing.assert_allclose(mutual_information(a, b), expected, atol=1e-12)


def test_labels_of_a_rendered_set_become_factors_and_others_do_not():
    labels = {
        "ambient": NUMBERS[:, 0].astype(np.float32),
        "camera_y_rad": NUMBERS[:, 1].astype(np.float32),
        "camera_tx": np.zeros(ROWS, np.float32),
        "diffuse": np.where(np.arange(ROWS) == 3, np.nan, 0.5).astype(np.float32),
        "expression": np.array(["sad", "happy", "anger"])[CLASSES],
        "identity": np.arange(ROWS).astype(str),
        "age": NUMBERS[:, 2].astype(np.float32),
    }
    result, left_out = true_factors(labels)
    assert [factor.name for factor in result] == ["ambient", "camera yaw", "expression"]
    assert [factor.is_class for factor in result] == [False, False, True]
    assert result[2].targets.shape == (ROWS, 3) and (result[2].targets.sum(axis=1) == 1).all()
    assert left_out.pop("diffuse") == "1 of 600 values are missing"
    assert left_out == {"shift x": "one value for all images", "identity": "600 classes of 600 images"}
    assert true_factors({**labels, "class": np.full(ROWS, "car")})[1]["class"] == "one class only"
    real = {"identity": CLASSES.astype(str), "age": labels["age"], "camera_tx": labels["camera_tx"]}
    assert true_factors(real) == ([], {})


def test_bad_input():
    with pytest.raises(ValueError, match="unknown method 'forest' of dimensions"):
        ground_truth_scores({"f": NUMBERS, "g": NUMBERS}, FACTORS, dimensions="forest")
