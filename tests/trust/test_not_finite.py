"""NaN and infinity put into every stage in turn: each is caught, and what is said names the stage."""

from collections.abc import Callable
from functools import partial
from math import inf, isfinite, isnan, nan

import pytest
import torch
from tests.training.conftest import noise_set
from torch import Tensor, nn

from derender.features.extract import embed_image_set
from derender.model import Derenderer
from derender.networks.decoders import Confidence
from derender.objectives import self_features
from derender.objectives.self_features import SelfFeatures, SelfTraining
from derender.postprocess import Features
from derender.postprocess.whitening import Projection, Whitening
from derender.renderers import as_renderer
from derender.scene.perturb import PerturbSettings
from derender.training import resolve, train
from derender.training.config import ObjectiveSettings, WhiteningSettings
from derender.training.derender_task import DerenderTask
from derender.training.features import fit_whitening
from derender.training.held_out_errors import NotFinite, errors_of
from derender.training.step import training_step
from derender.training.task import Progress, StepLosses
from derender.training.watch import Finding, FiniteWatch, Watcher, largest_gradients

SIZE = 32
MIDDLE = SIZE // 2
CONFIDENCES = tuple(Confidence.__dataclass_fields__)
NETS = {"geometry": "depth", "albedo": "albedo", "light": "light", "camera": "camera"}


@pytest.fixture
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=SIZE, width=4, light_width=4, code_size=16)


@pytest.fixture
def images(generator) -> Tensor:
    return torch.rand(2, 3, SIZE, SIZE, generator=generator)


def spoiled(values: Tensor, bad: float) -> Tensor:
    """One number of the first row replaced, of a map one in the middle."""
    changed = values.clone()
    middle = [side // 2 for side in values.shape[2:]]
    changed[(0, 0, *middle)] = bad
    return changed


def spoil(module: nn.Module, bad: float, call: int | None = None) -> None:
    """From now on a module gives a bad number, each time or only the n-th."""
    calls = 0

    def hook(_: nn.Module, __: object, output: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return spoiled(output, bad) if call in (None, calls) else output

    module.register_forward_hook(hook)


def spoil_net(name: str, part: str, model: Derenderer, bad: float, call: int | None = None) -> None:
    spoil(getattr(model.nets[name], part), bad, call)


def spoil_field(values: object, name: str, bad: float) -> object:
    """A dataclass of maps, one of them spoiled."""
    return type(values)(**{**vars(values), name: spoiled(getattr(values, name), bad)})


def spoil_confidence(name: str, model: Derenderer, bad: float) -> None:
    model.nets["confidence"].register_forward_hook(lambda _, __, output: spoil_field(output, name, bad))


def spoil_rendering(name: str, model: Derenderer, bad: float) -> None:
    plain = model.renderer
    model.renderer = as_renderer(lambda scene, fov: spoil_field(plain(scene, fov), name, bad), "lambert")


STAGES = {
    **{f"the code of {name}": partial(spoil_net, name, "encoder") for name in NETS},
    **{f"the predicted {said}": partial(spoil_net, name, "decoder") for name, said in NETS.items()},
    **{f"the {name} confidence": partial(spoil_confidence, name) for name in CONFIDENCES},
    **{f"the rendered {name}": partial(spoil_rendering, name) for name in ("image", "depth", "mask")},
    "the loss term 'loocc'": partial(spoil_net, "albedo", "encoder", call=2),  # of perturbed renderings
}
"""What the watcher has to name, and who spoils it."""


def seen(watch: FiniteWatch, result: StepLosses) -> tuple[Finding, ...]:
    stages, note = watch.note(result)
    return watch.look(4, stages, note.tolist())


def broken_gradient(model: Derenderer) -> str | None:
    names, largest = largest_gradients(model)
    return next((name for name, one in zip(names, largest.tolist(), strict=True) if not isfinite(one)), None)


def what_is_said(model: Derenderer, images: Tensor, perceptual: nn.Module | None = None) -> str:
    """What the watcher of a training says of one step; it has to end the run."""
    objective = ObjectiveSettings(loocc="light+camera", perceptual="self" if perceptual else "none")
    result = training_step(model, images, objective, perceptual, torch.Generator().manual_seed(0))
    watch = Watcher(model.settings.ranges, 4)
    findings = seen(watch, result)
    assert watch.uneasy and findings and findings[0].fatal
    return findings[0].text


def test_a_sound_step_raises_nothing(model, images):
    result = training_step(model, images, ObjectiveSettings(perceptual="none"), None, torch.Generator())
    result.total.backward()
    assert seen(Watcher(model.settings.ranges, 4), result) == ()
    assert broken_gradient(model) is None


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("stage", STAGES)
def test_each_stage_is_named(model, images, stage, bad):
    STAGES[stage](model, bad)
    if stage != "the predicted albedo" or isnan(bad):
        assert f"the first value that is not finite is {stage}" in what_is_said(model, images)
    else:  # a squashed infinity is a number: black or white
        assert model.decompose(images).albedo[0, 0, MIDDLE, MIDDLE] == (1 if bad > 0 else 0)


@pytest.mark.parametrize("bad", [nan, inf])
def test_perceptual_features(model, images, bad):
    features = SelfFeatures((4, 4, 4))
    features.register_forward_hook(lambda _, __, out: torch.full_like(out, bad) if out.requires_grad else out)
    assert "is the loss term 'perceptual'" in what_is_said(model, images, features)


def test_a_depth_that_is_no_number_leaves_the_loss_finite_and_is_seen_all_the_same(model, images):
    spoil(model.nets["geometry"].decoder, nan)
    objective = ObjectiveSettings(perceptual="none", curvature_weight=0, raised_weight=0, confidence=False)
    result = training_step(model, images, objective, None, torch.Generator().manual_seed(0))
    (finding,) = seen(Watcher(model.settings.ranges, 4), result)
    assert "the predicted depth" in finding.text
    assert result.total.isfinite()


@pytest.mark.parametrize("bad", [nan, inf])
def test_every_gradient(model, images, bad):
    result = training_step(model, images, ObjectiveSettings(perceptual="none"), None, torch.Generator())
    result.total.backward()
    learning = {name: value for name, value in model.named_parameters() if value.grad is not None}
    assert {name.split(".")[1] for name in learning} == {*NETS, "confidence"}
    for name, value in learning.items():
        assert value.grad is not None
        kept = value.grad.clone()
        value.grad.view(-1)[-1] = bad
        assert broken_gradient(model) == f"the gradient of {name}"
        value.grad.copy_(kept)
    assert broken_gradient(model) is None


def test_a_sum_that_overflows_is_no_broken_gradient(model):
    for value in model.parameters():
        value.grad = torch.full_like(value, 3e38)
    assert broken_gradient(model) is None


def run_of(spoiler: Callable[[Derenderer], None], folder, monkeypatch, *settings: str) -> tuple[Finding, ...]:
    """Train with a model that is spoiled as it is built; gives what ended the run. No file may hold a NaN."""
    build = DerenderTask.build

    def built(task: DerenderTask) -> Derenderer:
        model = build(task)
        spoiler(model)
        return model

    monkeypatch.setattr(DerenderTask, "build", built)
    tiny = (f"image_size={SIZE}", "width=4", "light_width=4", "batch_size=4", "images=12", "perceptual=none")
    result = train(resolve("small", (*tiny, "whitening.pictures=0", *settings)), noise_set(20), folder)
    assert result.stopped == "collapse"
    assert not list(folder.rglob("model.safetensors"))
    return result.findings


@pytest.mark.parametrize("watch", ["true", "false"])
def test_a_gradient_that_is_no_number_ends_a_run_before_it_is_used(tmp_path, monkeypatch, watch):
    trained: list[Derenderer] = []

    def spoiler(model: Derenderer) -> None:
        trained.append(model)
        decoder = model.nets["light"].decoder
        decoder.register_full_backward_hook(lambda _, ins, __: tuple(torch.full_like(x, nan) for x in ins))

    (finding,) = run_of(spoiler, tmp_path / "run", monkeypatch, f"watch={watch}")
    assert finding.fatal and "the gradient of nets.light.encoder" in finding.text
    assert all(bool(value.isfinite().all()) for value in trained[0].parameters())


def test_a_broken_step_leaves_the_weights_of_the_step_before(model, monkeypatch, tmp_path):
    """The third of nine; the notes of all of them are read at the end."""
    after: list[list[Tensor]] = []

    def built(task: DerenderTask) -> Derenderer:
        model.nets["light"].decoder.register_full_backward_hook(
            lambda _, inputs, __: tuple(one * (nan if len(after) == 2 else 1) for one in inputs)
        )
        return model

    def keep(progress: Progress) -> None:
        if progress.phase == "train":
            after.append([value.detach().clone() for value in model.parameters()])

    monkeypatch.setattr(DerenderTask, "build", built)
    tiny = ("batch_size=4", "images=36", "perceptual=none", "whitening.pictures=0", "fitting.examples=0")
    config = resolve("small", tiny).model_copy(update={"model": model.settings})
    result = train(config, noise_set(20), tmp_path / "run", progress=keep)
    assert (result.stopped, result.images, len(after)) == ("collapse", 12, 9)
    assert "the gradient of nets.light.encoder" in result.findings[-1].text
    same = [all(map(torch.equal, after[1], weights)) for weights in after]
    assert same == [False, True, *[True] * 7]


def test_held_out_pictures_that_are_rendered_as_no_numbers_end_a_run(tmp_path, monkeypatch):
    def spoiler(model: Derenderer) -> None:
        def hook(net: nn.Module, _: object, output: Tensor) -> Tensor:
            return output if net.training else torch.full_like(output, nan)

        model.nets["albedo"].decoder.register_forward_hook(hook)

    (finding,) = run_of(spoiler, tmp_path / "run", monkeypatch)
    assert "the loss of held-out images is not finite" in finding.text


@pytest.mark.parametrize("bad", [nan, inf])
def test_pictures(model, images, bad):
    for use in (model.embed, model.decompose, model.reconstruct):
        with pytest.raises(ValueError, match=r"image 0 of 2 holds values that are not finite"):
            use(spoiled(images, bad))


def test_what_perceptual_features_learn(monkeypatch):
    plain = self_features.nt_xent
    monkeypatch.setattr(self_features, "nt_xent", lambda *given: plain(*given) * nan)
    pixels = torch.randint(0, 256, (8, 3, SIZE, SIZE), dtype=torch.uint8)
    settings = SelfTraining(widths=(4, 4, 4), batch=4)
    with pytest.raises(ValueError, match="ended in weights that are NaN or infinite"):
        self_features.train_self_features(pixels, seed=0, steps=3, settings=settings)


@pytest.mark.parametrize("factor", ["geometry", "albedo"])
def test_whitening(model, images, factor):
    spoil(model.nets[factor].encoder.convolutions, nan)
    with pytest.raises(
        ValueError, match=f"whitening: NaN or infinity in the activations of {factor} of images 0"
    ):
        fit_whitening(model, images, WhiteningSettings(views=1), PerturbSettings())


@pytest.mark.parametrize("bad", [nan, inf])
@pytest.mark.parametrize("stage", ["encoder", "whitening"])
def test_embedding(model, stage, bad):
    if stage == "encoder":
        spoil(model.nets["albedo"].encoder, bad)
    else:
        width = model.activations(torch.zeros(1, 3, SIZE, SIZE))["albedo"].shape[1]
        maps = {"albedo": Projection(torch.zeros(width), torch.full((width, 16), bad), torch.ones(16))}
        model = model.with_features(Features(Whitening(maps)))
    with pytest.raises(ValueError, match=r"factor 'albedo' is not finite in \d+ of 20 rows, first in 000"):
        embed_image_set(model, noise_set(20), batch_size=20)


def test_held_out_errors(model):
    spoil(model.nets["albedo"].decoder, nan)
    with pytest.raises(NotFinite, match="the reconstructions of 20 of 20 images are NaN"):
        errors_of(model, noise_set(20).images, batch_size=1)


def test_baselines():
    terms = {"l1": torch.tensor(0.1), "commitment": torch.tensor(nan)}
    (finding,) = seen(FiniteWatch(), StepLosses(torch.tensor(nan), terms))
    assert finding.fatal and "the first term that is not finite is 'commitment'" in finding.text
