"""Where in the picture a factor's encoder saw what the probe answers with.

Sources: Grad-CAM (Selvaraju et al., ICCV 2017) at the encoder's last spatial convolution, the paper's choice;
HiResCAM (Draelos and Carin, 2020, arXiv 2011.08891), which multiplies gradient and feature place by place;
integrated gradients of the pixels through the whole encoder. In all of them the answer is the probe's logit
by way of ONE factor while the others are held. Grad-CAM averages the gradient over places, and these
encoders weigh every place of the last features by itself: it can light up where the answer does not look,
which HiResCAM cannot. Maps are 4 x 4 at the features: upsampled they show a region, not an outline.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from derender.data import suggestion
from derender.interpretation.probe import Probe
from derender.interpretation.shares import captum_attr
from derender.networks.encoders import activations

METHODS = ("grad-cam", "hires-cam", "pixels")
GREY = 0.5
PIXEL_STEPS = 16


def saliency(
    method: str,
    model: Any,
    images: Float[Tensor, "n 3 h w"],
    factor: str,
    probe: Probe | None = None,
    targets: Sequence[int] | np.ndarray = (),
) -> Float[Tensor, "n height width"]:
    """A map by the name of its method, none below 0: 4 x 4 for the two CAMs, the picture's size for pixels.

    Args:
        method: "grad-cam", "hires-cam" or "pixels".
        model: with ``nets[factor].encoder``, which has ``spatial`` and ``to_code``.
        images: in 0..1.
        factor: whose encoder is looked through.
        probe: whose logit is explained; None explains the feature itself (half its squared length), whatever
            is asked of it.
        targets: (n,) the label or class of each picture; needed with a probe.
    """
    if method not in METHODS:
        raise ValueError(
            f"unknown method {method!r}{suggestion(method, METHODS)}; there is {', '.join(METHODS)}"
        )
    weight = None if probe is None else factor_weights(probe, factor, targets).to(images)
    if weight is not None and len(weight) != len(images):
        raise ValueError(f"{len(images)} pictures need as many targets, got {len(weight)}")
    if method == "pixels":
        return pixel_attribution(model, images, factor, weight)[0]
    features, gradient = _at_features(model, images, factor, weight)
    if method == "grad-cam":
        gradient = gradient.mean(dim=(2, 3), keepdim=True)
    maps = (gradient * features).sum(dim=1)
    own, mirror = maps[: len(images)], maps[len(images) :]
    return (own + mirror.flip(-1) if len(mirror) else own).relu()


def factor_weights(probe: Probe, factor: str, targets: Sequence[int] | np.ndarray) -> Float[Tensor, "n code"]:
    """The probe's weights on one factor's feature, for the target of each picture."""
    if factor not in probe.sizes:
        raise ValueError(f"the probe has no factor {factor!r}; it has {', '.join(probe.factors)}")
    return torch.from_numpy(probe.weight[np.asarray(targets, np.int64), probe.slices[factor]])


def score(code: Float[Tensor, "n c"], weight: Tensor | None) -> Float[Tensor, " n"]:
    """A factor's part of the logit, or half the squared length of its feature.

    Where the probe knows coordinates of fitted scenes, too, the part that encoders read comes first, alone.
    """
    return code.square().sum(dim=1) / 2 if weight is None else (code * weight[:, : code.shape[1]]).sum(dim=1)


def _at_features(
    model: Any, images: Tensor, factor: str, weight: Tensor | None
) -> tuple[Float[Tensor, "m c y x"], Float[Tensor, "m c y x"]]:
    """The last spatial features of an encoder, and the gradient of the answer there.

    Where the feature is made of pictures and their mirror images, those of the mirror images follow.
    """
    encoder, mirrors = model.nets[factor].encoder, model.features.mirrors(factor)
    seen = torch.cat([images, images.flip(-1)]) if mirrors else images
    with torch.enable_grad():
        features = encoder.spatial(seen).detach().requires_grad_()
        active = activations(encoder.to_code(features).flatten(1), features)
        if mirrors:
            active = torch.cat(active.chunk(2), dim=1)
        answer = score(model.features_from({factor: active})[factor], weight).sum()
        (gradient,) = torch.autograd.grad(answer, features)
    return features.detach(), gradient


def pixel_attribution(
    model: Any,
    images: Float[Tensor, "n 3 h w"],
    factor: str,
    weight: Tensor | None,
    steps: int = PIXEL_STEPS,
) -> tuple[Float[Tensor, "n h w"], Float[Tensor, " n"]]:
    """|IG| of the pixels from a grey picture, summed over colours, and the relative completeness error."""

    def answer(pictures: Tensor, own: Tensor | None = None) -> Tensor:
        active = model.factor_activations(factor, pictures)
        return score(model.features_from({factor: active})[factor], own)

    grey = torch.full_like(images[:1], GREY)
    with torch.enable_grad():
        attribution, delta = captum_attr().IntegratedGradients(answer).attribute(
            images, grey, additional_forward_args=weight, n_steps=steps, return_convergence_delta=True,
            internal_batch_size=max(len(images), 64),
        )  # fmt: skip
    attribution, delta = attribution.detach(), delta.detach()
    change = (attribution.sum(dim=(1, 2, 3)) - delta).abs().max().clamp(min=1e-12)
    return attribution.abs().sum(dim=1).to(images), (delta.abs() / change).to(images)


def upsampled(maps: Float[Tensor, "n y x"], size: int) -> Float[Tensor, "n size size"]:
    """Maps at the picture's size, bilinear between the centres of their cells."""
    return interpolate(maps[:, None], (size, size), mode="bilinear", align_corners=False)[:, 0]


def to_one(maps: Float[Tensor, "n y x"]) -> Float[Tensor, "n y x"]:
    """Each map divided by its own largest value; an empty map stays empty."""
    top = maps.amax(dim=(1, 2), keepdim=True)
    return torch.where(top > 0, maps / top.clamp(min=torch.finfo(maps.dtype).tiny), 0.0)
