"""Attribution: each factor's share of an answer, and where in the image its encoder saw it.

Shares: integrated gradients of a probe (Sundararajan et al., ICML 2017), computed by captum. A factor's
share (Klinghoffer et al., ECCV 2022) is the sum of |IG| over its dimensions, over the sum of all. A zero
baseline counts a feature that is large in every image; the mean as baseline does not.

Maps explain the probe's logit by way of one factor, the others held. Grad-CAM (Selvaraju et al., ICCV 2017)
at the encoder's last spatial convolution is the paper's choice. It averages the gradient over places, so it
can light up where the answer does not look. HiResCAM (Draelos and Carin, arXiv 2011.08891) multiplies
gradient and activation place by place. The third are integrated gradients of the pixels.

Sanity check of maps: Adebayo et al., NeurIPS 2018. A map that stays the same when the encoder's weights are
drawn anew shows the image, not the model. One that stays with shuffled labels shows the encoder's interest,
whatever the question. The verdict goes by Spearman's rank correlation over the places of the map. SSIM is
that of the maps at the image's size, each divided by its largest value.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import rankdata
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from derender.baselines.controls import untrained_twin
from derender.evaluation.pixels import masked_ssim
from derender.interpretation.probe import Probe
from derender.render import warp
from derender.scene.crop import back, crop_images
from derender.storage.places import optional, require_known

STEPS = {"logit": 2, "probability": 32}  # a logit is linear in the features: any number is exact
NUMBERS_AT_ONCE = 4_000_000
METHODS = ("grad-cam", "hires-cam", "pixels")
GREY = 0.5
PIXEL_STEPS = 16
UNCHANGED = 0.5
CHANGES = ("random weights", "shuffled labels", "another image")
Images = Float[Tensor, "n 3 h w"]  # in 0..1
Targets = Sequence[int] | np.ndarray  # the label or class of each image


def captum_attr() -> ModuleType:
    """captum's attribution methods; ValueError with the extra to install where it is missing."""
    return optional("captum.attr", "an explanation", "explain")


def integrated_gradients(
    probe: Probe, z: np.ndarray, target: int, *, baseline: np.ndarray | None = None, output: str = "logit"
) -> tuple[np.ndarray, np.ndarray]:
    """The contribution of each dimension to one answer, from the baseline to the image.

    ``z`` are (N, D) features, ``target`` is the number of the label or class. ``baseline`` (D,) is zero by
    default, as in the paper. ``output`` is "logit" or "probability". Returns (N, D) attributions, and (N,)
    completeness errors: their sum less the change of the answer.
    """
    require_known("output", output, tuple(STEPS))
    together = output == "probability" and probe.kind == "classes"  # only there the other answers matter
    rows = slice(None) if together else slice(target, target + 1)
    weight, bias = (torch.from_numpy(v[rows].astype(np.float64)) for v in (probe.weight, probe.bias))

    def answer(given: Tensor) -> Tensor:
        logits = given @ weight.T + bias
        if output == "logit":
            return logits[:, 0]
        return logits.softmax(dim=1)[:, target] if together else logits[:, 0].sigmoid()

    method, inputs = captum_attr().IntegratedGradients(answer), torch.from_numpy(z.astype(np.float64))
    if not len(z):
        return np.zeros(z.shape), np.zeros(0)
    start = inputs.new_tensor(np.zeros((1, z.shape[1])) if baseline is None else baseline[None])
    how = {"n_steps": STEPS[output], "internal_batch_size": max(len(z), NUMBERS_AT_ONCE // z.shape[1])}
    result, error = method.attribute(inputs, start, **how, return_convergence_delta=True)
    return result.detach().numpy(), error.detach().numpy()


def factor_shares(attributions: np.ndarray, probe: Probe) -> np.ndarray:
    """(N, D) attributions as (N, F) shares of |IG|, which sum to 1; NaN where nothing was attributed."""
    size = np.abs(attributions)
    parts = np.stack([size[:, columns].sum(axis=1) for columns in probe.slices.values()], axis=1)
    total = parts.sum(axis=1, keepdims=True)
    return np.divide(parts, total, out=np.full_like(parts, np.nan), where=total > 0)


def saliency(
    method: str, model: Any, images: Images, factor: str, probe: Probe | None = None, targets: Targets = ()
) -> Float[Tensor, "n height width"]:
    """A map by one of ``METHODS``, none below 0: 4 x 4 for the two CAMs, the image's size for pixels.

    The encoder of ``factor`` has ``spatial`` and ``to_code``; images are in 0..1. The probe's logit for the
    (n,) label or class of each image is explained; None explains the feature itself (half its squared
    length).
    """
    weight = None
    if probe is not None:
        weight = torch.from_numpy(probe.weight[np.asarray(targets), probe.slices[factor]]).to(images)
    if method == "pixels":
        return pixel_attribution(model, images, factor, weight)
    features, gradient = _at_features(model, images, factor, weight)
    if method == "grad-cam":
        gradient = gradient.mean(dim=(2, 3), keepdim=True)
    maps = (gradient * features).sum(dim=1)
    own, mirror = maps[: len(images)], maps[len(images) :]
    maps = (own + mirror.flip(-1) if len(mirror) else own).relu()
    framing, turned = model.features.framing(factor), model.features.turns(factor)
    if framing is None and not turned:
        return maps
    shown = upsampled(maps, images.shape[-1])[:, None]
    framed, crops = model.framed(images) if framing is not None else (images, None)
    if turned:  # back from the canonical view
        depth, camera = model.surface(framed)
        shown = warp(shown, depth, camera, model.fov_deg).image
    if crops is not None:  # back from the crop
        shown = crop_images(shown, back(crops), torch.zeros_like(shown))
    return adaptive_avg_pool2d(shown, maps.shape[-1])[:, 0]


def score(code: Float[Tensor, "n c"], weight: Tensor | None) -> Float[Tensor, " n"]:
    """A factor's part of the logit, or half the squared length of its feature.

    Of features that include coordinates of optimised scenes, only the encoder's part, which comes first.
    """
    return code.square().sum(dim=1) / 2 if weight is None else (code * weight[:, : code.shape[1]]).sum(dim=1)


def _at_features(
    model: Any, images: Tensor, factor: str, weight: Tensor | None
) -> tuple[Float[Tensor, "m c y x"], Float[Tensor, "m c y x"]]:
    """The last spatial features of an encoder, and the gradient of the answer there.

    Where the feature is made of images and their mirror images, those of the mirror images follow. Of one
    made of the canonical view they are that view's.
    """
    seen: list[Tensor] = []
    to_code = model.nets[factor].encoder.to_code
    look = to_code.register_forward_pre_hook(lambda _, given: seen.append(given[0].requires_grad_()))
    with torch.enable_grad(), look:
        answer = _answer(model, factor, images, weight).sum()
        seen = seen[-2 if model.features.mirrors(factor) else -1 :]  # before them the surface was decoded
        gradients = torch.autograd.grad(answer, seen)
    return torch.cat(seen).detach(), torch.cat(gradients)


def pixel_attribution(
    model: Any, images: Images, factor: str, weight: Tensor | None
) -> Float[Tensor, "n h w"]:
    """|IG| of the pixels from a grey image, summed over colours."""
    grey = torch.full_like(images[:1], GREY)
    with torch.enable_grad():
        method = captum_attr().IntegratedGradients(partial(_answer, model, factor))
        how = {"n_steps": PIXEL_STEPS, "internal_batch_size": max(len(images), 64)}
        result = method.attribute(images, grey, additional_forward_args=weight, **how)
    return result.detach().abs().sum(dim=1).to(images)


def _answer(model: Any, factor: str, images: Tensor, weight: Tensor | None = None) -> Float[Tensor, " n"]:
    active = model.factor_activations(factor, images)
    return score(model.features_from({factor: active})[factor], weight)


def upsampled(maps: Float[Tensor, "n y x"], size: int) -> Float[Tensor, "n size size"]:
    """Maps at the image's size, bilinear between the centres of their cells."""
    return interpolate(maps[:, None], (size, size), mode="bilinear", align_corners=False)[:, 0]


def to_one(maps: Float[Tensor, "n y x"]) -> Float[Tensor, "n y x"]:
    """Each map divided by its own largest value; an empty map stays empty."""
    return maps / maps.amax(dim=(1, 2), keepdim=True).clamp(min=torch.finfo(maps.dtype).tiny)


@dataclass(frozen=True)
class Similarity:
    """Similarity of the maps of one method and factor before and after a change.

    ``spearman`` is the mean rank correlation over images and seeds, 1 for unchanged, ``spread`` its
    deviation. ``empty`` is the share of comparisons left out, a map being empty or flat.
    """

    method: str
    factor: str
    changed: str
    spearman: float
    ssim: float
    spread: float
    empty: float


def sanity_check(
    model: Any, probe: Probe, shuffled: Probe, images: Tensor, targets: np.ndarray, *,
    methods: Sequence[str] = METHODS, seeds: Sequence[int] = (0, 1, 2),
) -> list[Similarity]:  # fmt: skip
    """Compare the maps of a model with those of fresh weights (by seed), shuffled labels, another image.

    ``probe`` is explained, ``shuffled`` learned shuffled labels. Two ``images`` or more are in 0..1,
    ``targets`` the label or class explained for each.
    """
    twins, result = [untrained_twin(model, seed) for seed in seeds], []
    asked = [(model, probe), (model, shuffled), *((twin, probe) for twin in twins)]
    for method, factor in product(methods, probe.factors):
        own, learned, *fresh = (saliency(method, net, images, factor, one, targets) for net, one in asked)
        for changed, others in zip(CHANGES, (fresh, [learned], [own.roll(1, dims=0)]), strict=True):
            result.append(similarity(method, factor, changed, own, others, images.shape[-1]))
    return result


def similarity(
    method: str, factor: str, changed: str, own: Tensor, others: Sequence[Tensor], size: int
) -> Similarity:
    """Mean similarity of maps (n, y, x) with each of several others of the same images."""
    everywhere = torch.ones(len(own), size, size, device=own.device)
    shown, *drawn = (upsampled(to_one(maps), size)[:, None].expand(-1, 3, -1, -1) for maps in (own, *others))
    ranks = np.concatenate([spearman(own, other) for other in others])
    ssim = np.concatenate([masked_ssim(shown, other, everywhere).cpu().numpy() for other in drawn])
    known = np.isfinite(ranks)
    mean = alike = spread = float("nan")
    if known.any():
        mean, alike, spread = map(float, (ranks[known].mean(), ssim[known].mean(), ranks[known].std()))
    return Similarity(method, factor, changed, mean, alike, spread, float(1 - known.mean()))


def spearman(first: Tensor, second: Tensor) -> np.ndarray:
    """Rank correlation over the places of each pair of maps, (n,); NaN where one of them is flat."""
    a, b = (rankdata(maps.flatten(1).cpu().double().numpy(), axis=1) for maps in (first, second))
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    length = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return np.divide((a * b).sum(axis=1), length, out=np.full(len(a), np.nan), where=length > 0)
