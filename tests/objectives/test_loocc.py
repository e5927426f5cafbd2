"""NT-Xent against pytorch-metric-learning, and what leaving a factor out does to loss and gradient."""

import math

import pytest
import torch
from pytorch_metric_learning.losses import NTXentLoss

from derender.objectives.loocc import NOTHING_LEFT_OUT, loocc_loss, nt_xent

CLOSE = {"rtol": 1e-5, "atol": 1e-6}
FACTORS = ("geometry", "albedo", "light", "camera")


def oracle(a, b, temperature=0.5):
    """The same loss by an independent implementation: 2N embeddings, two of each label."""
    labels = torch.arange(len(a)).repeat(2)
    return NTXentLoss(temperature=temperature)(torch.cat([a, b]), labels)


def codes(generator, n=6, sizes=(8, 8, 5, 3), requires_grad=False):
    drawn = [torch.randn(n, size, generator=generator) for size in sizes]
    return {name: value.requires_grad_(requires_grad) for name, value in zip(FACTORS, drawn, strict=True)}


@pytest.mark.parametrize("n", [2, 3, 17])
@pytest.mark.parametrize("temperature", [0.1, 0.5, 2.0])
def test_value_and_gradients_agree_with_pytorch_metric_learning(generator, n, temperature):
    a, b = (torch.randn(n, 6, generator=generator, requires_grad=True) for _ in range(2))
    ours, theirs = nt_xent(a, b, temperature), oracle(a, b, temperature)
    torch.testing.assert_close(ours, theirs, **CLOSE)
    gradients = (torch.autograd.grad(loss, (a, b)) for loss in (ours, theirs))
    for mine, other in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, other, **CLOSE)


@pytest.mark.parametrize("size", [1e-10, 1e4, 1e30])
def test_codes_of_any_size_are_safe(generator, size):
    a, b = (torch.randn(4, 8, generator=generator) for _ in range(2))
    large = (a * size).requires_grad_()
    loss = nt_xent(large, b * size)
    loss.backward()
    torch.testing.assert_close(loss.detach(), nt_xent(a, b), **CLOSE)
    assert large.grad.isfinite().all()


def test_a_code_of_zeros_has_similarity_zero_and_no_gradient(generator):
    a, b = (torch.randn(3, 4, generator=generator) for _ in range(2))
    a[1] = 0
    loss = nt_xent(a.requires_grad_(), b.requires_grad_())
    loss.backward()
    assert loss.isfinite() and a.grad.isfinite().all() and b.grad.isfinite().all()
    assert torch.equal(a.grad[1], torch.zeros(4))
    for same in (torch.zeros(3, 4), torch.ones(3, 4)):
        assert nt_xent(same, same).item() == pytest.approx(math.log(5), rel=1e-6)


def test_half_precision_codes_are_compared_in_float32_even_under_autocast(generator):
    a, b = (torch.randn(16, 32, generator=generator).bfloat16() for _ in range(2))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = nt_xent(a, b)
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, nt_xent(a.float(), b.float()), rtol=0, atol=0)


@pytest.mark.parametrize("perturbed", [[-1] * 6, [3] * 6, [2, 3, 2, 2, 0, NOTHING_LEFT_OUT]])
def test_the_loss_is_the_oracle_on_the_images_that_kept_each_factor(generator, perturbed):
    first, again, perturbed = codes(generator), codes(generator), torch.tensor(perturbed)
    total, contrasted = 0.0, 0
    for index, name in enumerate(FACTORS):
        kept = perturbed != index
        if kept.any():
            total = total + oracle(first[name][kept], again[name][kept]) * kept.sum()
        contrasted += int(kept.sum())
    torch.testing.assert_close(loocc_loss(first, again, perturbed), total / contrasted, **CLOSE)
    backwards = {name: again[name] for name in reversed(FACTORS)}
    torch.testing.assert_close(loocc_loss(first, backwards, perturbed), total / contrasted, **CLOSE)


def test_the_perturbed_factor_of_an_image_gets_no_gradient_and_everything_else_does(generator):
    first, again = codes(generator, requires_grad=True), codes(generator, requires_grad=True)
    perturbed = torch.tensor([2, 3, 2, 3, 0, 1])
    loocc_loss(first, again, perturbed).backward()
    for index, name in enumerate(FACTORS):
        for side in (first, again):
            touched = side[name].grad.abs().sum(dim=1) > 0
            assert touched.tolist() == (perturbed != index).tolist(), name


def test_a_factor_that_fewer_than_two_images_kept_contributes_nothing(generator):
    first, again = codes(generator, n=2, requires_grad=True), codes(generator, n=2)
    loss = loocc_loss(first, again, torch.tensor([2, 3]))  # light is kept by one image, camera by the other
    expected = torch.stack([oracle(first[name], again[name]) for name in ("geometry", "albedo")]).mean()
    torch.testing.assert_close(loss, expected, **CLOSE)
    loss.backward()
    assert torch.equal(first["light"].grad, torch.zeros(2, 5))
    light = torch.randn(2, 5, generator=generator, requires_grad=True)
    nothing = loocc_loss({"light": light}, {"light": light * 2}, torch.tensor([0, 0]))
    nothing.backward()
    assert nothing.item() == 0 and torch.equal(light.grad, torch.zeros(2, 5))


def test_the_joint_loss_compares_codes_side_by_side_without_what_was_perturbed(generator):
    first, again = codes(generator, requires_grad=True), codes(generator)
    nothing = torch.tensor([NOTHING_LEFT_OUT] * 6)
    both = [torch.cat([side[name] for name in FACTORS], dim=1) for side in (first, again)]
    torch.testing.assert_close(loocc_loss(first, again, nothing, joint=True), nt_xent(*both), **CLOSE)
    others = [name for name in FACTORS if name != FACTORS[2]]
    without = [torch.cat([side[name] for name in others], dim=1) for side in (first, again)]
    loss = loocc_loss(first, again, torch.tensor([2] * 6), joint=True)
    torch.testing.assert_close(loss, nt_xent(*without), **CLOSE)
    loss.backward()
    assert first[FACTORS[2]].grad is None or not first[FACTORS[2]].grad.any()
    mixed = torch.tensor([2, 2, -1, 2, -1, -1])
    anchors = torch.tensor([2, 2, -1, 2, -1, -1] * 2)
    rows = [_per_anchor(*pair) for pair in (without, both)]
    expected = torch.where(anchors == 2, *rows).mean()
    torch.testing.assert_close(loocc_loss(first, again, mixed, joint=True), expected, **CLOSE)


def _per_anchor(a, b):
    views = torch.nn.functional.normalize(torch.cat([a, b]), dim=1)
    logits = (views @ views.T / 0.5).fill_diagonal_(-math.inf)
    rows = torch.arange(len(views))
    return -logits.log_softmax(dim=1)[rows, (rows + len(a)) % len(views)]


def test_gradcheck_with_factors_left_out(generator):
    options = {"generator": generator, "dtype": torch.float64, "requires_grad": True}
    values = [torch.randn(3, 2, **options) for _ in range(4)]

    def loss(a, b, c, d):
        return loocc_loss({"x": a, "y": b}, {"x": c, "y": d}, torch.tensor([0, 1, -1]))

    assert torch.autograd.gradcheck(loss, values)


TWO = {"light": torch.zeros(2, 3)}


@pytest.mark.parametrize(
    ("first", "again", "perturbed", "message"),
    [
        (TWO, {"camera": torch.zeros(2, 3)}, [0, 0], "same factors"),
        (TWO, TWO, [0, 1], r"must lie in -1\.\.0 \(light\), got \[0, 1\]"),
        (TWO, {"light": torch.zeros(2, 4)}, [0, 0], "one shape"),
        ({}, {}, [], "at least one factor"),
        ({"light": torch.zeros(1, 4)}, {"light": torch.zeros(1, 4)}, [0], "light: .*at least 2 images"),
    ],
)
def test_bad_input_is_named(first, again, perturbed, message):
    with pytest.raises(ValueError, match=message):
        loocc_loss(first, again, torch.tensor(perturbed, dtype=torch.long))
    with pytest.raises(ValueError, match="temperature must be positive"):
        nt_xent(torch.ones(2, 3), torch.ones(2, 3), temperature=0.0)
    with pytest.raises(ValueError, match="at least 2 images"):
        nt_xent(torch.zeros(0, 4), torch.zeros(0, 4))
