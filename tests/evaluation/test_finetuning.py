"""Joint training: both objectives reach the encoders, runs resume exactly, models load, held-out scores."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.training.conftest import assert_same_weights, weights
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, one_hot

import derender
from derender.data import ImageSet
from derender.evaluation import finetuning
from derender.evaluation.finetuning import FinetuneTask, load_finetuned, target_of
from derender.evaluation.linear_probes import head_loss
from derender.evaluation.memory import Memory
from derender.report.run import run_page
from derender.training.batches import random_stream
from derender.training.config import PRESETS, FinetuneConfig, with_changes
from derender.training.loop import train_task
from derender.training.run_folder import RunFolder, read_metrics
from derender.training.task import Step, compute_step, network_precision

TINY = ["image_size=32", "width=4", "light_width=4", "perceptual=none", "batch_size=8", "patience=99"]
TINY += ["validate_every=32", "checkpoint_every=32", "deterministic=true", "watch=false", "warmup_images=0"]
TINY += ["final_rate=1"]  # resuming with more images goes on at the same rate


@pytest.fixture(scope="module")
def pictures() -> ImageSet:
    """Bright and dark images of which some carry no label; three shades; a value that never changes."""
    random = np.random.default_rng(0)
    shade = np.arange(60) % 3
    images = random.integers(0, 60, (60, 3, 32, 32)) + 80 * shade[:, None, None, None]
    bright = np.where(shade == 2, 1, 0).astype(np.int8)
    bright[::10] = -1
    labels = {"bright": bright, "dark": (shade == 0).astype(np.int8), "same": np.zeros(60, np.int8)}
    labels["shade"] = np.array(["low", "middle", "high"])[shade]
    files = tuple(f"{row:02d}.png" for row in range(60))
    return ImageSet(images.astype(np.uint8), files, labels, source="made by the test")


def config(*more: str, labels=("shade",), **explicit) -> FinetuneConfig:
    base = FinetuneConfig(**PRESETS["small"].model_dump(mode="json"))
    return with_changes(base, [*TINY, *more], target__labels=list(labels), **explicit)


def task(pictures, *more: str, start=None, **how) -> FinetuneTask:
    one = config(*more, **how)
    return FinetuneTask(one, pictures.images, target_of(pictures, one), start)


def test_both_objectives_reach_the_encoders(pictures, tmp_path):
    """The total is the weighted sum of what each gives alone, and so are its gradients."""

    def gradient(weight: float, rendering: float) -> tuple[float, torch.Tensor]:
        one = task(pictures, target__weight=weight, target__rendering_weight=rendering)
        model = one.build()
        nothing = torch.zeros(0, 3, 32, 32, dtype=torch.uint8)
        module = Step(model, one.losses(model, RunFolder(tmp_path), nothing, lambda *at: None))
        rows = one.target.split.train[:8]
        images = torch.from_numpy(pictures.images[rows]).float() / 255
        precision = network_precision("32-true", torch.device("cpu"))
        stream = random_stream(0, "perturb", 0)
        losses = compute_step(module, images, stream, precision, 0.5, torch.from_numpy(rows))
        assert set(losses.terms) - {"target"} <= set(finetuning.RENDERING_TERMS)
        losses.total.backward()
        nets = (model.model.nets[one] for one in ("geometry", "albedo"))
        results = [net.encoder.convolutions[0].weight.grad for net in nets]
        return losses.total.item(), torch.stack(results)

    target, rendering = gradient(1.0, 0.0), gradient(1e-12, 1.0)
    both = gradient(2.0, 3.0)
    assert both[0] == pytest.approx(2 * target[0] + 3 * rendering[0], rel=1e-4)
    expected = 2 * target[1] + 3 * rendering[1]
    assert (both[1] - expected).abs().max() < 1e-3 * expected.abs().max()
    assert target[1].abs().max() > 0 and rendering[1].abs().max() > 0


def test_a_resumed_run_ends_with_the_very_weights_and_the_model_loads(pictures, tmp_path):
    whole, first, second = (task(pictures, f"images={count}") for count in (64, 32, 64))
    train_task(whole, pictures, tmp_path / "whole")
    train_task(first, pictures, tmp_path / "parts")
    train_task(second, pictures, tmp_path / "parts", resume=True)
    assert_same_weights(tmp_path / "whole", tmp_path / "parts")
    kinds = [row["kind"] for row in read_metrics(tmp_path / "whole")]
    assert kinds.count("validation") == 2
    judged = [row for row in read_metrics(tmp_path / "whole") if row["kind"] == "validation"]
    assert all(row["loss"] == row["target"] for row in judged)  # held-out images are judged by the task

    model = derender.load(tmp_path / "whole")
    images = torch.from_numpy(pictures.images[:4]).float() / 255
    tuned = load_finetuned(tmp_path / "whole")
    assert torch.equal(tuned.model.embed(images)["geometry"], model.embed(images)["geometry"])
    assert tuned.predict(images).sum(dim=1) == pytest.approx(np.ones(4), abs=1e-5)
    best = weights(tmp_path / "whole", "best")
    assert torch.equal(best["head.linear.weight"], tuned.head.linear.weight)
    assert "Preset small" in run_page(tmp_path / "whole").html()
    with pytest.raises(ValueError, match="was trained with another target"):
        other = task(pictures, "images=96", labels=("dark",))
        train_task(other, pictures, tmp_path / "whole", resume=True)


def test_it_learns_beside_the_controls_and_leaves_its_start_alone(pictures, tmp_path):
    start = derender.Derenderer.from_preset("small", seed=5, image_size=32, width=4, light_width=4)
    start = start.eval().requires_grad_(False)
    before = {name: value.clone() for name, value in start.state_dict().items()}
    fast = ["images=240", "learning_rate=5e-3", "rendering_weight=0", "split=[0.4, 0.2, 0.4]"]
    one = task(pictures, *fast, start=start, labels=("bright", "dark"))
    last = one.build().model.nets["albedo"].decoder.last.weight
    assert torch.equal(last, before["nets.albedo.decoder.last.weight"])
    train_task(one, pictures, tmp_path / "run")
    tuned, first, second = load_finetuned(tmp_path / "run"), Memory(tmp_path / "m"), Memory(tmp_path / "m")
    result = finetuning.score_finetuned(tuned, one, resample_count=50, memory=first)
    again = finetuning.score_finetuned(tuned, one, resample_count=50, memory=second)
    assert str(again.values) == str(result.values) and result.values["n_unlabelled"] == 0
    assert (second.made, second.recalled) == (0, first.made) and first.made == 9
    targets = one.target.asked.targets.copy()
    targets[one.target.split.train[:3]] = -1
    fewer = replace(one, target=replace(one.target, asked=replace(one.target.asked, targets=targets)))
    some = finetuning.score_finetuned(tuned, fewer, resample_count=50, memory=second)
    assert some.values["n_unlabelled"] == 3 and "3 images without label" in some.tables[0].caption
    rows = {row.name: row.scores["balanced_accuracy"].value for row in result.result}
    assert rows["fine-tuned"] > 0.9 and rows["majority"] == 0.5
    assert [result.values[name] for name in ("kind", "n_train", "n_test")] == ["labels", 24, 24]
    assert result.values["versus"]["accuracy"]["rival"] != "fine-tuned"
    table = result.tables[0].values()
    controls = ["untrained encoder, logistic", "PCA (6), logistic", "pixels, logistic", "majority"]
    assert list(table) == ["fine-tuned", "frozen, logistic", "frozen, paper's head", *controls]
    assert rows["pixels, logistic"] > 0.9  # brightness is in the pixels themselves
    assert all(torch.equal(value, before[name]) for name, value in start.state_dict().items())
    assert not any(parameter.requires_grad for parameter in start.parameters())
    name = "nets.geometry.encoder.convolutions.0.weight"
    assert not torch.equal(derender.load(tmp_path / "run").state_dict()[name], before[name])


def test_labels_beyond_those_asked_for_and_those_tested_stay_hidden(pictures):
    target = target_of(pictures, config(target__labelled=7))
    train, held, tested = (getattr(target.split, part) for part in ("train", "validation", "test"))
    assert (target.visible[train] >= 0).any(axis=1).sum() == 7
    assert (target.visible[held] == target.asked.targets[held]).all() and (target.visible[tested] == -1).all()
    smaller = target_of(pictures, config(target__labelled=3)).visible
    assert ((smaller >= 0) <= (target.visible >= 0)).all()


def test_the_loss_of_a_head_is_torchs_cross_entropy_over_what_is_known():
    logits, classes = torch.randn(6, 3, generator=torch.Generator().manual_seed(0)), torch.arange(6) % 3
    one_of = one_hot(classes, 3).float()
    one_of[4:] = -1
    yes_no = torch.tensor([[1.0, -1], [0, 1], [-1, -1]])
    known = logits[[0, 1, 1], [0, 0, 1]], torch.tensor([1.0, 0, 1])
    for kind, shown, targets, expected in (
        ("classes", logits, one_of, cross_entropy(logits[:4], classes[:4])),
        ("labels", logits[:3, :2], yes_no, binary_cross_entropy_with_logits(*known)),
        ("classes", logits, torch.full((6, 3), -1.0), torch.tensor(0.0)),
        ("labels", logits, torch.full((6, 3), -1.0), torch.tensor(0.0)),
    ):
        assert head_loss(shown[None], targets[None], kind)[0] == pytest.approx(expected.item())


def test_bad_input_is_named_before_a_folder_is_made(pictures, tmp_path):
    for labels, message in (
        ((), "name a label to learn; the images have bright, dark"),
        (("shades",), "has no label 'shades'; did you mean 'shade'"),
    ):
        with pytest.raises(ValueError, match=message):
            target_of(pictures, config(labels=labels))
    shade = np.full(60, "high")
    shade[target_of(pictures, config()).split.train] = "low"
    with pytest.raises(ValueError, match="48 labelled images to learn from have one class of shade only"):
        target_of(replace(pictures, labels={"shade": shade}), config())
    with pytest.raises(ValueError, match="48 with shade: set labelled=48 or fewer"):
        target_of(pictures, config(target__labelled=49))
    with pytest.raises(ValueError, match="unknown factor 'geomtry'; did you mean 'geometry'"):
        train_task(task(pictures, target__factors=["geomtry"]), pictures, tmp_path / "run")
    wide = derender.Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4)
    with pytest.raises(ValueError, match=r"leave out settings of model\.network"):
        train_task(task(pictures, start=wide), pictures, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    plain = derender.Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)
    plain.save(tmp_path / "plain")
    with pytest.raises(FileNotFoundError, match="has no head"):
        load_finetuned(tmp_path / "plain")
    one = task(pictures)
    saved = one.build().save(tmp_path / "head")
    (saved / "head.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match=r"the head in .* is damaged"):
        load_finetuned(saved)
    nothing = replace(one.target.asked, targets=np.full_like(one.target.asked.targets, -1))
    with pytest.raises(ValueError, match="test part has 0 images with a label"):
        finetuning.score_finetuned(one.build(), replace(one, target=replace(one.target, asked=nothing)))


def test_every_batch_of_the_loop_gets_its_labels(pictures, tmp_path, monkeypatch):
    forward, seen = Step.forward, set()

    def noted(step, images, generator, precision, done=None, rows=None):
        for image, row in zip((images * 255).round().byte().numpy(), rows.tolist(), strict=True):
            views = pictures.images[row], pictures.images[row][..., ::-1]
            assert any((image == view).all() for view in views)
            seen.add(row)
        return forward(step, images, generator, precision, done, rows)

    monkeypatch.setattr(Step, "forward", noted)
    one = task(pictures, "images=48", "rendering_weight=0")
    train_task(one, pictures, tmp_path / "run")
    assert seen == {*one.target.split.train.tolist(), *one.target.split.validation.tolist()}
