"""Photometric and perceptual losses against closed forms, the laws that masks obey, and depth penalties."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from derender.objectives import reconstruction
from derender.objectives.perceptual import perceptual_loss
from derender.objectives.reconstruction import depth_smoothness, masked_l1, photometric_loss, relief

depth_curvature = partial(depth_smoothness, order=2)
EXACT = {"rtol": 1e-12, "atol": 1e-12}


def pictures(generator, n=2, h=5, w=7, dtype=torch.float64):
    prediction = torch.rand(n, 3, h, w, generator=generator, dtype=dtype)
    target = torch.rand(n, 3, h, w, generator=generator, dtype=dtype)
    mask = (torch.rand(n, h, w, generator=generator) < 0.6).to(dtype)
    sigma = 0.1 + torch.rand(n, 1, h, w, generator=generator, dtype=dtype)
    return prediction, target, mask, sigma


both = pytest.mark.parametrize("loss_of", [photometric_loss, perceptual_loss])
sigma_or_not = pytest.mark.parametrize("with_sigma", [True, False])


@both
def test_constant_error_and_sigma_give_the_closed_form(loss_of):
    prediction, target = (torch.full((1, 3, 4, 6), value, dtype=torch.float64) for value in (0.7, 0.4))
    sigma = torch.full((1, 1, 4, 6), 0.5, dtype=torch.float64)
    mask = torch.ones(1, 4, 6, dtype=torch.float64)
    plain = 0.3 if loss_of is photometric_loss else 0.3**2
    scaled = math.sqrt(2) * 0.3 / 0.5 if loss_of is photometric_loss else 0.3**2 / (2 * 0.5**2)
    assert loss_of(prediction, target, mask, sigma).item() == pytest.approx(scaled + math.log(0.5), abs=1e-5)
    assert loss_of(prediction, target, mask, None).item() == pytest.approx(plain, abs=1e-12)


@both
def test_gradients_with_respect_to_prediction_target_and_sigma(loss_of, generator):
    prediction, target, mask, sigma = pictures(generator, n=2, h=3, w=2)
    inputs = [value.requires_grad_() for value in (prediction, target, sigma)]
    assert torch.autograd.gradcheck(lambda p, t, s: loss_of(p, t, mask, s), inputs)
    assert torch.autograd.gradcheck(lambda p, t: loss_of(p, t, mask, None), inputs[:2])


@both
@sigma_or_not
def test_an_empty_mask_gives_zero_and_no_gradient(loss_of, generator, with_sigma):
    prediction, target, mask, sigma = pictures(generator)
    inputs = [prediction.requires_grad_(), *[sigma.requires_grad_()] * with_sigma]
    loss = loss_of(prediction, target, torch.zeros_like(mask), sigma if with_sigma else None)
    assert loss.item() == 0
    assert all((gradient == 0).all() for gradient in torch.autograd.grad(loss, inputs))


@both
@pytest.mark.parametrize("poison", [float("nan"), float("inf"), 1e30])
@sigma_or_not
def test_values_outside_the_mask_change_neither_loss_nor_gradient(loss_of, generator, poison, with_sigma):
    prediction, target, mask, sigma = pictures(generator)
    results = []
    for value in (0.0, poison):
        p, s = (torch.where(mask[:, None] > 0, x, value).requires_grad_() for x in (prediction, sigma))
        loss = loss_of(p, target, mask, s if with_sigma else None)
        results.append([loss, *torch.autograd.grad(loss, (p, s) if with_sigma else (p,))])
    for clean, poisoned in zip(*results, strict=True):
        torch.testing.assert_close(poisoned, clean, rtol=0, atol=0)
        assert (clean.dim() == 0) or bool((clean.abs().sum(1)[mask == 0] == 0).all())


@both
def test_half_precision_is_computed_in_float32(loss_of, generator):
    prediction, target, mask, sigma = (x.bfloat16() for x in pictures(generator))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = loss_of(prediction, target, mask.float(), sigma)
    expected = loss_of(prediction.double(), target.double(), mask.double(), sigma.double())
    assert loss.dtype == torch.float32
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)


def test_pixel_by_pixel_definition(generator):
    """The mean runs over all kept pixels of the batch, not over its images."""
    prediction, target, mask, sigma = pictures(generator)
    mask[1, 1:] = 0
    errors, losses = [], []
    for n, v, u in mask.nonzero().tolist():
        errors.append(sum(abs((prediction - target)[n, c, v, u].item()) for c in range(3)) / 3)
        spread = math.hypot(sigma[n, 0, v, u].item(), reconstruction.SIGMA_FLOOR)
        losses.append(math.sqrt(2) * errors[-1] / spread + math.log(spread))
    assert 0 < len(errors) < mask.numel()
    loss, plain = (torch.tensor(sum(each) / len(each), dtype=torch.float64) for each in (losses, errors))
    torch.testing.assert_close(photometric_loss(prediction, target, mask, sigma), loss, **EXACT)
    for kept in (mask, mask.bool()):
        torch.testing.assert_close(masked_l1(prediction, target, kept), plain, **EXACT)


@given(st.floats(0, 1e4))
@settings(max_examples=50, deadline=None)
def test_bounded_sigma_stays_above_the_floor_and_close_to_sigma(value):
    result = reconstruction.bounded_sigma(torch.tensor([value], dtype=torch.float64)).item()
    assert result >= max(reconstruction.SIGMA_FLOOR, value) * (1 - 1e-12)
    assert result - value <= reconstruction.SIGMA_FLOOR
    if value >= 0.1:
        assert result == pytest.approx(value, rel=1e-4)


def test_a_sigma_of_zero_gives_a_finite_loss_and_gradient(generator):
    prediction, target, mask, _ = pictures(generator, dtype=torch.float32)
    sigma = torch.zeros(2, 1, 5, 7, requires_grad=True)
    prediction.requires_grad_()
    loss = photometric_loss(prediction, target, mask, sigma)
    loss.backward()
    assert loss.isfinite() and sigma.grad.isfinite().all() and prediction.grad.isfinite().all()
    raw = torch.full((2, 1, 5, 7), -9.0, requires_grad=True)
    photometric_loss(prediction, target, mask, torch.nn.functional.softplus(raw)).backward()
    assert (raw.grad[mask[:, None] > 0] < 0).all(), "a sigma far below the error must be pushed up again"


def test_depth_penalties_of_known_surfaces():
    rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    assert depth_smoothness(torch.full((2, 6, 9), 1.05)).item() == 0
    ramp = (0.02 * rows + 0.03 * columns)[None]
    assert depth_smoothness(ramp, depth_range=0.2).item() == pytest.approx((0.02 + 0.03) / 0.2, rel=1e-5)
    step = (columns >= 4).float()[None] * 0.2
    assert depth_smoothness(step, depth_range=0.2).item() == pytest.approx(1 / 8, rel=1e-5)
    assert depth_curvature(ramp + 1).item() == pytest.approx(0, abs=1e-5)
    bowl = (0.01 * rows**2 + 0.02 * columns**2)[None]
    assert depth_curvature(bowl, depth_range=0.2).item() == pytest.approx((0.02 + 0.04) / 0.2, rel=1e-4)


def test_relief_is_the_height_of_parabolas_along_columns_and_rows():
    down, across = torch.linspace(-1, 1, 9)[:, None], torch.linspace(-1, 1, 6)
    saddle = 1 + 0.03 * down**2 - 0.05 * across**2 + 0.02 * down + 0.01 * across**3
    clamped = torch.nn.functional.pad(torch.stack([saddle, 2 - saddle]), (2, 2), value=1.04)
    torch.testing.assert_close(relief(clamped, border=2), torch.tensor([[0.3, -0.5], [-0.3, 0.5]]))


@pytest.mark.parametrize(("penalty", "least"), [(depth_smoothness, 2), (depth_curvature, 3)])
def test_depth_penalties_leave_the_border_out_and_refuse_too_small_maps(penalty, least, generator):
    inside = 1 + 0.05 * torch.rand(2, 5, 6, generator=generator)
    clamped = torch.nn.functional.pad(inside, (2, 2), value=1.04)
    torch.testing.assert_close(penalty(clamped, border=2), penalty(inside))
    assert penalty(clamped) != penalty(inside)
    depth = torch.rand(1, 4, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(penalty, (depth,))
    with pytest.raises(ValueError, match=f"{least} rows and {least} columns"):
        penalty(torch.ones(1, 5, 3 + least), border=2)
    with pytest.raises(ValueError, match="depth_range must be above 0"):
        penalty(torch.ones(1, 5, 5), depth_range=0.0)
