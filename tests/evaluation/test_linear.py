"""The linear protocol: rows, the paper's head, penalised regression and scores against oracles; controls."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.special import expit, softmax
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import accuracy_score, average_precision_score, balanced_accuracy_score, recall_score
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.neighbors import KNeighborsClassifier
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

from derender import Derenderer
from derender.baselines.autoencoders import Autoencoder, AutoencoderSettings
from derender.baselines.supervised import fresh_resnet18
from derender.evaluation import linear_probes
from derender.evaluation.linear_probes import HEADS, HeadSettings, logistic_weights, probe
from derender.evaluation.linear_probing import compare_linear, finetune
from derender.evaluation.linear_task import Task, choose_rows, count_scores, linear_scores, task_of
from derender.evaluation.memory import Memory

QUICK = HeadSettings(epochs=3, batch_size=16)


def problem(rows: int = 160, labels: int = 3, seed: int = 0) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Features that hold each label in a direction of its own, and noise."""
    rng = np.random.default_rng(seed)
    hidden = rng.normal(size=(rows, labels))
    features = np.hstack([hidden @ rng.normal(size=(labels, 6)), 0.5 * rng.normal(size=(rows, 4))])
    columns = {f"a{at}": (hidden[:, at] > 0.3 * at).astype(np.int8) for at in range(labels)}
    return features, columns


def files(count: int) -> list[str]:
    return [f"{number}.png" for number in range(count)]


def test_two_values_are_asked_yes_or_no_and_more_are_a_choice():
    task = task_of({"a": np.array([1, 0, -1, 1, 0], np.int8), "b": np.array(["x", "y", "y", "x", ""])})
    assert task.kind == "labels" and task.names == ("a", "b")
    assert task.targets.tolist() == [[1, 0], [0, 1], [-1, 1], [1, 0], [0, -1]]
    task = task_of({"who": np.array(["c", "a", "b", "", "a", "c", "b"])})
    assert task.kind == "classes" and task.names == ("a", "b", "c")
    assert task.targets[:4].tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, -1]]
    assert task.known.tolist() == [True, True, True, False, True, True, True]


@pytest.mark.parametrize(
    ("labels", "message"),
    [({}, "at least one label column"), ({"a": np.ones(4)}, "two classes, the 4 labelled rows of 'a' have 1"),
     ({"a": np.array(["x", "x", "y"])}, "class 'y' of label 'a' has one row"),
     ({"a": np.arange(6) % 3, "b": np.arange(6) % 2}, "'a' has 3 classes and cannot be asked together")],
)  # fmt: skip
def test_tasks_that_cannot_be_asked(labels, message):
    with pytest.raises(ValueError, match=message):
        task_of(labels)


def test_training_rows_are_nested_and_never_tested():
    _, columns = problem()
    columns["a0"][7] = columns["a1"][7] = columns["a2"][7] = -1
    task = task_of(columns)
    rows = choose_rows(task, files(160), (10, 40), (0, 1, 2))
    assert rows.train[10].shape == (3, 10) and rows.train[40].shape == (3, 40)
    assert np.array_equal(rows.train[40][:, :10], rows.train[10])
    assert not set(rows.test) & set(rows.train[40].ravel()) and 7 not in {*rows.test, *rows.train[40].ravel()}
    assert len(np.unique(rows.train[40], axis=0)) == 3
    again = choose_rows(task, files(160), (10,), (1,))
    assert np.array_equal(again.test, rows.test) and np.array_equal(again.train[10][0], rows.train[10][1])


def test_the_owners_test_part_and_groups_are_kept():
    task = task_of(problem()[1])
    partition = np.array(["train", "test", "validation", "train"])[np.arange(160) % 4]
    rows = choose_rows(task, files(160), (10,), (0,), partition=partition)
    assert (partition[rows.test] == "test").all() and len(rows.test) == 40
    assert list(choose_rows(task, files(160), partition=partition).train) == [100]
    rows = choose_rows(task, files(160), (50,), (0,), groups=(people := np.arange(160) // 8))
    assert not set(people[rows.test]) & set(people[rows.train[50][0]])


@pytest.mark.parametrize(
    ("counts", "options", "message"),
    [((10, 100), {}, "learn from 10, 100 labelled rows: 80 can be learned from and 80 are tested"),
     ((), {}, "learn from no labelled rows"), ((10,), {"seeds": ()}, "at least one seed"),
     ((10,), {"test_fraction": 1.0}, "0 can be learned from and 160 are tested")],
)  # fmt: skip
def test_rows_that_cannot_be_chosen(counts, options, message):
    with pytest.raises(ValueError, match=message):
        choose_rows(task_of(problem()[1]), files(160), counts, **options)


@pytest.mark.parametrize("kind", ["labels", "classes"])
def test_heads_trained_at_once_are_those_trained_one_by_one_in_plain_torch(kind):
    features, columns = problem(60)
    task = task_of(columns) if kind == "labels" else task_of({"who": np.arange(60) % 3})
    targets = task.targets.copy()
    if kind == "labels":
        targets[3, 1] = -1
    rows, tested, seeds = np.stack([np.arange(20), np.arange(10, 30)]), np.arange(40, 60), (4, 5)
    together = probe("linear", features, Task(kind, task.names, targets), rows, tested, seeds, settings=QUICK)
    for own, seed, result in zip(rows, seeds, together, strict=True):
        generator, reach = torch.Generator().manual_seed(seed), features.shape[1] ** 0.5
        head = torch.nn.Linear(features.shape[1], targets.shape[1])
        head.weight.data = ((torch.rand(head.weight.T.shape, generator=generator) * 2 - 1) / reach).T
        head.bias.data = (torch.rand(targets.shape[1], generator=generator) * 2 - 1) / reach
        optimiser = torch.optim.Adam(head.parameters(), lr=2e-4)
        x, y = torch.from_numpy(features).float(), torch.from_numpy(targets).float()
        for _ in range(QUICK.epochs):
            for batch in torch.from_numpy(own)[torch.randperm(len(own), generator=generator)].split(16):
                logits, known = head(x[batch]), y[batch] >= 0
                loss = binary_cross_entropy_with_logits(logits[known], y[batch][known])
                if kind == "classes":
                    loss = cross_entropy(logits, y[batch])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
        answer = head(x[tested]).sigmoid() if kind == "labels" else head(x[tested]).softmax(dim=1)
        np.testing.assert_allclose(result, answer.detach().numpy(), atol=2e-6)


@pytest.mark.parametrize(("rows", "dimensions"), [(80, 10), (30, 90)])
@pytest.mark.parametrize("kind", ["labels", "classes"])
def test_penalised_regression_is_scikit_learns(kind, rows, dimensions):
    rng = np.random.default_rng(rows)
    features = rng.normal(size=(rows + 20, dimensions)) * rng.uniform(0.1, 9, dimensions)
    features[:, 0] = 3.0  # a constant tells nothing
    classes = (features[:, 1] / features[:, 1].std() + rng.normal(size=rows + 20) * 0.3).argsort().argsort()
    targets = (classes[:, None] * 3 // len(classes) == np.arange(3)).astype(np.int8)
    deviation = features[:rows].std(axis=0) * (dimensions - 1) ** 0.5
    deviation[0] = np.inf
    standard = (features - features[:rows].mean(axis=0)) / deviation
    for penalty in (0.3, 20.0):
        how = {"kind": kind, "penalties": (penalty,), "folds": 2}
        weight, bias, _ = logistic_weights(features[:rows], targets[:rows], **how)
        logits, oracle = features @ weight + bias, LogisticRegression(C=penalty, tol=1e-9, max_iter=10_000)
        if kind == "classes":
            expected = oracle.fit(standard[:rows], targets[:rows].argmax(axis=1)).predict_proba(standard)
            np.testing.assert_allclose(softmax(logits, axis=1), expected, atol=2e-4)
        for label in range(3) if kind == "labels" else ():
            expected = oracle.fit(standard[:rows], targets[:rows, label]).predict_proba(standard)[:, 1]
            np.testing.assert_allclose(expit(logits[:, label]), expected, atol=2e-4)


def test_each_label_gets_the_penalty_that_plain_cross_validation_chooses():
    features, columns = problem(100, seed=2)
    targets, grid = task_of(columns).targets, (1e-3, 1e-1, 10.0)
    targets[5, 0] = -1
    how = {"kind": "labels", "penalties": grid, "folds": 4}
    weight, bias, chosen = logistic_weights(features[:60], targets[:60], **how)
    answers, fold = expit(features[60:] @ weight + bias), np.random.default_rng(0).permutation(60) % 4
    learned_from = features[:60]
    standard = (features - learned_from.mean(axis=0)) / (learned_from.std(axis=0) * features.shape[1] ** 0.5)
    for label in range(3):
        known = targets[:60, label] >= 0
        regression, folds = LogisticRegression(tol=1e-8, max_iter=5_000), PredefinedSplit(fold[known])
        search = GridSearchCV(regression, {"C": grid}, scoring="neg_log_loss", cv=folds)
        search.fit(standard[:60][known], targets[:60, label][known])
        assert chosen[label] == search.best_params_["C"]
        np.testing.assert_allclose(answers[:, label], search.predict_proba(standard[60:])[:, 1], atol=1e-3)


def test_a_centred_head_does_not_see_where_features_lie():
    features, columns = problem(80)
    task, rows, tested = task_of(columns), np.stack([np.arange(30), np.arange(10, 40)]), np.arange(40, 80)
    ask = partial(probe, task=task, rows=rows, tested=tested, seeds=(0, 1), settings=QUICK)
    straight, moved = ask("centred", features), ask("centred", features + 3)
    np.testing.assert_allclose(moved, straight, atol=1e-4)
    assert np.abs(ask("linear", features + 3) - ask("linear", features)).max() > 0.1
    mean = features[rows[1]].mean(axis=0)
    alone = probe("linear", features - mean, task, rows[1:], tested, (1,), settings=QUICK)
    np.testing.assert_allclose(straight[1], alone[0], atol=1e-5)


@pytest.mark.parametrize("head", linear_probes.PROBES)
def test_nothing_of_the_test_part_reaches_what_is_learned(head):
    """Other features and labels for some of the tested rows leave the answers for all others as they were."""
    features, columns = problem(80)
    rows, tested = np.arange(30)[None], np.arange(40, 80)
    straight = probe(head, features, task_of(columns), rows, tested, (0,), settings=QUICK)
    features[40:50] += 100
    for column in columns.values():
        column[40:80] = 1 - column[40:80]
    changed = probe(head, features, task_of(columns), rows, tested, (0,), settings=QUICK)
    np.testing.assert_allclose(changed[:, 10:], straight[:, 10:], atol=1e-6)
    assert np.abs(changed[:, :10] - straight[:, :10]).max() > 0.01


def test_neighbours_are_scikit_learns():
    features, columns = problem(90)
    targets = task_of(columns).targets
    centred = features - features[:50].mean(axis=0)
    oracle = KNeighborsClassifier(10, metric="cosine").fit(centred[:50], targets[:50])
    expected = np.stack([share[:, 1] for share in oracle.predict_proba(centred[50:])], axis=1)
    result = linear_probes.nearest_answers(features[:50], targets[:50], features[50:])
    np.testing.assert_allclose(result, expected)


@pytest.mark.parametrize("seed", range(20))
def test_scores_of_labels_are_scikit_learns(seed):
    rng = np.random.default_rng(seed)
    targets = rng.integers(0, 2, (rng.integers(6, 31), rng.integers(1, 5))).astype(np.int8)
    targets[:2], answers = [[0], [1]], rng.random(targets.shape).round(1) + 0.01
    result = linear_scores(targets, answers, "labels")
    columns = list(zip(targets.T, answers.T, strict=True))
    plain = [(accuracy_score(y, p > 0.5), balanced_accuracy_score(y, p > 0.5)) for y, p in columns]
    assert [result.accuracy, result.balanced_accuracy] == pytest.approx(np.mean(plain, axis=0))
    precision = np.mean([average_precision_score(y, p) for y, p in columns])
    assert result.average_precision == pytest.approx(precision)


def test_scores_of_classes_are_scikit_learns():
    rng = np.random.default_rng(0)
    classes = np.concatenate([rng.integers(0, 4, 40), [0, 1, 2, 3]])
    targets, answers = (classes[:, None] == np.arange(5)).astype(np.int8), rng.random((44, 5))
    result = linear_scores(targets, answers, "classes")
    assert result.accuracy == pytest.approx(accuracy_score(classes, answers.argmax(axis=1)))
    recall = recall_score(classes, answers.argmax(axis=1), labels=range(4), average="macro")
    assert result.balanced_accuracy == pytest.approx(recall)
    precisions = [average_precision_score(targets[:, one], answers[:, one]) for one in range(4)]
    assert result.average_precision == pytest.approx(np.mean(precisions))


def test_resampled_scores_are_those_of_rows_written_out():
    rng = np.random.default_rng(0)
    targets, answers = rng.integers(-1, 2, (30, 3)).astype(np.int8), rng.random((30, 3))
    weights = rng.multinomial(30, np.full(30, 1 / 30), size=5).astype(np.float32)
    result = count_scores(targets, answers, "labels", weights)
    for drawn, scores in zip(weights, result, strict=True):
        rows = np.repeat(np.arange(30), drawn.astype(int))
        written = linear_scores(targets[rows], answers[rows], "labels")
        assert scores == pytest.approx([written.accuracy, written.balanced_accuracy])


def comparison(tmp_path=None, **options):
    features, columns = problem(200)
    task = task_of(columns)
    rows = choose_rows(task, files(200), (20, 60), (0, 1, 2))
    noise = [np.random.default_rng(seed).normal(size=(200, 5)) for seed in range(2)]
    memory = Memory(tmp_path)
    result = compare_linear(
        {"ours": [features], "noise": noise}, task, rows, (0, 1, 2),
        controls=("noise",), settings=QUICK, resample_count=100, memory=memory, **options,
    )  # fmt: skip
    return result, memory, task, rows


def test_features_that_hold_the_labels_are_above_every_control(tmp_path):
    result, memory, task, rows = comparison(tmp_path)
    assert [(part.head, part.count) for part in result.parts] == [(h, n) for h in HEADS for n in (20, 60)]
    logistic = next(part for part in result.parts if (part.head, part.count) == ("logistic", 60))
    ours, noise, majority = logistic.rows
    assert ours.versus["accuracy"].above and ours.versus["balanced_accuracy"].above
    assert ours.scores["accuracy"].value > 0.85 and ours.runs == 3 and ours.scores["accuracy"].deviation > 0
    assert noise.scores["balanced_accuracy"].value == pytest.approx(0.5, abs=0.08)
    answers = linear_probes.majority_answers(task, rows.train[60], 100)[0]
    expected = linear_scores(task.targets[rows.test], answers, "labels")
    assert majority.scores["balanced_accuracy"].value == 0.5 and expected.balanced_accuracy == 0.5
    assert majority.control and result.n_test == 100
    made = memory.made
    again, memory, *_ = comparison(tmp_path)
    assert made == memory.recalled == 18 and memory.made == 0  # 3 heads x 2 counts x (1 + 2) runs
    assert str(again.numbers()) == str(result.numbers())
    assert not any(row.versus["average_precision"].above for row in logistic.rows if row.versus)


@pytest.mark.parametrize(
    ("head", "features", "message"),
    [("logistics", np.ones((4, 2)), "unknown head 'logistics'; did you mean 'logistic'"),
     ("k-NN", np.array([[1.0], [np.inf], [0], [0]]), "not finite in 1 of 4 rows"),
     ("logistic", np.ones((4, 2)), "2 rows cannot be cut into 5 folds")],
)  # fmt: skip
def test_probes_refuse_bad_input_in_words(head, features, message):
    task = Task("labels", ("a",), np.array([[0], [1], [0], [1]], np.int8))
    with pytest.raises(ValueError, match=message):
        probe(head, features, task, np.array([[0, 1]]), np.array([2, 3]), (0,))


def tiny_autoencoder() -> Autoencoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Autoencoder(AutoencoderSettings(image_size=32, width=4))


NETS = {
    "ours": lambda: Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4),
    "a baseline": tiny_autoencoder,
    "a fresh ResNet-18": lambda: fresh_resnet18(32, 0, width=4),
}


@pytest.mark.parametrize("kind", NETS)
def test_bright_and_dark_pictures_are_learned_through_the_encoders(kind):
    rng = np.random.default_rng(0)
    bright = rng.integers(0, 2, 32)
    images = (rng.integers(0, 60, (32, 3, 32, 32)) + 150 * bright[:, None, None, None]).astype(np.uint8)
    model = NETS[kind]().eval()
    model.requires_grad_(False)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    task = task_of({"bright": bright.astype(np.int8)})
    rows, tested, done = np.arange(16), np.arange(16, 32), []
    options = {"settings": HeadSettings(learning_rate=3e-3, epochs=8, batch_size=8), "seed": 3}
    answers = finetune(model, images, task, rows, tested, progress=lambda *at: done.append(at), **options)
    assert linear_scores(task.targets[tested], answers, "labels").accuracy == 1
    assert done[-1] == (8, 8)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert not any(parameter.requires_grad for parameter in model.parameters())
    again = finetune(model, images, task, rows, tested, **options)
    assert again == pytest.approx(answers, abs=1e-4)
