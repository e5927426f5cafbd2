"""Questions and probes: bins, bad labels, both heads held against the project's own, files."""

import numpy as np
import pytest
from scipy.special import expit, softmax

from derender.evaluation.linear_probes import HeadSettings, logistic_weights, probe
from derender.evaluation.linear_task import task_of
from derender.interpretation import fit_probe, load_probe, question
from derender.interpretation.probe import FOLDS, PENALTIES, in_bins

N = 80


@pytest.fixture
def features() -> dict[str, np.ndarray]:
    geometry, light = np.random.default_rng(0).standard_normal((2, N, 5)).astype(np.float32)
    return {"geometry": geometry, "light": light + 1}


@pytest.fixture
def labels(features) -> dict[str, np.ndarray]:
    score = features["geometry"][:, 0]
    sizes = np.digitize(score, [-0.5, 0.5]).astype(np.int64)
    result = {"smiling": (score > 0).astype(np.int8), "size": sizes, "age": score.astype(np.float64)}
    return {**result, "same": np.full(N, "one"), "few": np.where(np.arange(N) < 5, "a", "")}


@pytest.mark.parametrize("name", ["smiling", "size"])
def test_probes_answer_as_the_projects_own_heads(features, labels, name):
    task = task_of({name: labels[name]})
    rows, tested = np.arange(0, 60), np.arange(60, N)
    x = np.concatenate(list(features.values()), axis=1)
    settings = HeadSettings(learning_rate=0.01, epochs=5, batch_size=16)
    test = {key: values[tested] for key, values in features.items()}

    paper = fit_probe(features, task, rows, head="linear", seed=3, settings=settings)
    heads = probe("linear", x, task, rows[None], tested, [3], settings=settings)
    np.testing.assert_allclose(paper.probabilities(test), heads[0], atol=1e-5)

    ours = fit_probe(features, task, rows, seed=3)
    how = {"kind": task.kind, "penalties": PENALTIES, "folds": FOLDS, "seed": 3}
    weight, bias, _ = logistic_weights(x[rows], task.targets[rows], **how)
    logits = x[tested] @ weight + bias
    wanted = softmax(logits, axis=1) if task.kind == "classes" else expit(logits)
    np.testing.assert_allclose(ours.probabilities(test), wanted, atol=1e-4)
    again = fit_probe(features, task, rows, seed=3)
    np.testing.assert_array_equal(ours.weight, again.weight)


def test_a_probe_comes_back_from_its_folder(features, labels, tmp_path):
    probe = fit_probe(features, task_of({"smiling": labels["smiling"]}), np.arange(N))
    back = load_probe(probe.save(probe.save(tmp_path / "probe"), overwrite=True))
    np.testing.assert_array_equal(back.weight, probe.weight)
    assert (back.names, back.kind, back.sizes) == (probe.names, probe.kind, probe.sizes)
    np.testing.assert_allclose(back.probabilities(features), expit(probe.logits(features)))
    with pytest.raises(FileExistsError, match="choose another folder"):
        probe.save(tmp_path / "probe")
    with pytest.raises(FileNotFoundError, match="no probe at"):
        load_probe(tmp_path)
    (tmp_path / "probe" / "probe.safetensors").write_bytes(b"junk")
    with pytest.raises(ValueError, match="fit it again"):
        load_probe(tmp_path / "probe")
    with pytest.raises(ValueError, match="needs 5 numbers of factor 'light', the features have 2"):
        probe.logits({**features, "light": features["light"][:, :2]})


def test_numbers_are_cut_into_equal_bins():
    values = np.append(np.random.default_rng(0).permutation(90) / 10, np.nan)
    cut = in_bins(values, 3)
    names, counts = np.unique(cut[:-1], return_counts=True)
    assert counts.tolist() == [30, 30, 30] and cut[-1] == ""
    assert [name[:2] for name in names] == ["1:", "2:", "3:"]
    assert values[:-1][cut[:-1] == names[0]].max() < values[:-1][cut[:-1] == names[1]].min()
    identities = np.arange(30)
    assert in_bins(identities) is identities
    assert len(np.unique(in_bins(identities, 2))) == 2


def test_bad_questions(labels):
    assert question(labels, ["age"]).names[0].startswith("1: ")
    with pytest.raises(ValueError, match=r"has same one, so there is nothing to distinguish.*ing, size, age"):
        question(labels, ["same"])
    with pytest.raises(ValueError, match="known for 5 images, and an explanation needs 20"):
        question(labels, ["few"])
    with pytest.raises(ValueError, match="2 bins or more"):
        question(labels, ["age"], bins=1)


def test_rare_values_are_left_out_and_words_say_what_yes_means(labels):
    words = np.where(labels["smiling"] == 1, "smile", "frown").astype(object)
    words[3] = "wink"
    asked = question({"mouth": words}, ["mouth"])
    assert asked.names == ("mouth: smile",) and asked.kind == "labels"
    assert asked.targets[3, 0] == -1 and (np.delete(asked.targets[:, 0], 3) >= 0).all()
    assert question(labels, ["smiling"]).names == ("smiling",)
