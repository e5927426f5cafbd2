"""Laws of integrated gradients and of the shares of factors in answers, clusters and pairs."""

import numpy as np
import pytest

from derender.evaluation.linear_task import Rows, task_of
from derender.interpretation import cluster_shares, explain_labels, pair_parts
from derender.interpretation.attribution import factor_shares, integrated_gradients
from derender.interpretation.probe import Probe

SIZES = {"geometry": 4, "albedo": 4, "light": 4}


def probe_of(weight, bias=(0.3, -0.2), kind="labels") -> Probe:
    weight = np.asarray(weight, np.float32)
    return Probe(kind, ("a", "b"), SIZES, weight, np.asarray(bias, np.float32))


@pytest.fixture
def z() -> np.ndarray:
    return np.random.default_rng(1).standard_normal((30, 12)).astype(np.float32)


@pytest.fixture
def weight() -> np.ndarray:
    return np.random.default_rng(2).standard_normal((2, 12)).astype(np.float32)


@pytest.mark.parametrize("kind", ["labels", "classes"])
@pytest.mark.parametrize("output", ["logit", "probability"])
def test_attributions_sum_to_the_change_of_the_answer(z, weight, kind, output):
    probe = probe_of(weight, kind=kind)
    start = np.full(12, 0.1)
    result, error = integrated_gradients(probe, z, 1, baseline=start, output=output)

    def answer(values):
        logits = values @ weight.T.astype(np.float64) + probe.bias
        if output == "logit":
            return logits[:, 1]
        if kind == "labels":
            return 1 / (1 + np.exp(-logits[:, 1]))
        return np.exp(logits[:, 1]) / np.exp(logits).sum(axis=1)

    change = answer(z.astype(np.float64)) - answer(start[None])
    np.testing.assert_allclose(result.sum(axis=1), change, atol=2e-5)
    assert np.abs(error).max() < 2e-5


def test_a_yes_or_no_has_the_same_shares_as_logit_and_as_probability(z, weight):
    probe = probe_of(weight)
    outputs = ("logit", "probability")
    both = (integrated_gradients(probe, z, 0, output=output)[0] for output in outputs)
    logit, probability = (factor_shares(one, probe) for one in both)
    np.testing.assert_allclose(logit, probability, atol=1e-6)
    np.testing.assert_allclose(logit.sum(axis=1), 1)


def shares_of(features, weight):
    return factor_shares(integrated_gradients(probe_of(weight), features, 0)[0], probe_of(weight))


def test_one_used_factor_has_everything_and_symmetric_factors_equal_shares(z, weight):
    alone = weight.copy()
    alone[:, :4] = alone[:, 8:] = 0
    np.testing.assert_allclose(shares_of(z, alone), np.tile([0.0, 1.0, 0.0], (len(z), 1)), atol=1e-12)
    z[:, 4:8] = z[:, 8:] = z[:, :4]
    weight[:, 4:8] = -weight[:, :4]
    weight[:, 8:] = weight[:, :4]
    np.testing.assert_allclose(shares_of(z, weight), 1 / 3, atol=1e-9)


def test_bad_words(z, weight, monkeypatch):
    with pytest.raises(ValueError, match="did you mean 'logit'"):
        integrated_gradients(probe_of(weight), z, 0, output="logits")

    def missing(name, *rest):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr("importlib.import_module", missing)
    with pytest.raises(ValueError, match=r"pip install 'derender\[explain\]'"):
        integrated_gradients(probe_of(weight), z, 0)


N = 240


@pytest.fixture(scope="module")
def known():
    """Geometry tells `shape`, light tells `lit`, albedo is large and tells nothing."""
    generator = np.random.default_rng(0)
    features = {name: generator.standard_normal((N, 4)).astype(np.float32) for name in SIZES}
    features["albedo"] += 3
    shape, lit = ((features[name][:, 0] > 0).astype(np.int8) for name in ("geometry", "light"))
    rows = Rows(np.arange(120, N), {80: np.stack([generator.permutation(120)[:80] for _ in range(2)])})
    return features, task_of({"shape": shape, "lit": lit}), rows


def explained(known, **words):
    features, task, rows = known
    noise = {n: np.random.default_rng(9).standard_normal((N, 4)).astype(np.float32) for n in SIZES}
    return explain_labels(features, task, rows, seeds=(0, 1), untrained=[noise], **words)


def test_the_factor_that_knows_has_the_share_and_the_drop(known):
    result = explained(known, baseline="mean")
    model, *controls = result.rows
    assert [row.name for row in controls] == ["shuffled labels", "untrained encoder"]
    assert all(row.control for row in controls) and not model.control
    shares = model.shares.mean(axis=0)
    assert shares[0].argmax() == 0 and shares[1].argmax() == 2 and (shares.max(axis=1) > 0.6).all()
    np.testing.assert_allclose(model.shares.sum(axis=2), 1)
    assert ((model.low <= shares) & (shares <= model.high)).all()
    assert (model.auc > 0.95).all() and (model.drop[:, 0, 0] > 0.2).all()
    assert np.abs(model.drop[:, :, 1]).max() < 0.03
    for control in controls:
        assert np.abs(control.auc - 0.5).max() < 0.3
        assert control.shares.mean(axis=0)[0, 0] < shares[0, 0] - 0.15
    assert model.error < 1e-6 and model.shares.shape == (2, 2, 3) and controls[1].shares.shape[0] == 1


def test_a_zero_baseline_counts_a_constant_feature_and_the_same_seed_repeats(known):
    zero, mean = (explained(known, baseline=name).rows[0].shares.mean(axis=0) for name in ("zero", "mean"))
    assert (zero[:, 1] > mean[:, 1]).all()
    assert explained(known).numbers() == explained(known).numbers()


def test_classes_are_explained_on_their_own_pictures(known):
    features, _, rows = known
    third = np.digitize(features["geometry"][:, 0], [-0.5, 0.5])
    result = explain_labels(features, task_of({"third": third}), rows, seeds=(0, 1), baseline="mean")
    assert result.names == ("0", "1", "2") and result.rows[0].shares.shape == (2, 3, 3)
    assert (result.rows[0].shares.mean(axis=0)[[0, 2]].argmax(axis=1) == 0).all()
    assert (result.rows[0].auc[:, [0, 2]] > 0.85).all()


def test_an_explanation_refuses_what_does_not_fit(known):
    features, task, rows = known
    with pytest.raises(ValueError, match="unknown baseline 'black'"):
        explain_labels(features, task, rows, seeds=(0, 1), baseline="black")
    with pytest.raises(ValueError, match="3 seeds need as many choices"):
        explain_labels(features, task, rows, seeds=(0, 1, 2))


@pytest.fixture
def features() -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    return {name: generator.standard_normal((60, 3)) for name in ("geometry", "albedo", "light")}


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
