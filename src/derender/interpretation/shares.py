"""Integrated gradients of a probe, and each factor's share of them.

Source: Sundararajan et al., ICML 2017, computed by captum; the share is that of Klinghoffer et al., ECCV 2022
(caption of the Grad-CAM figure): the sum of |IG| over a factor's dimensions, over the sum of all. Of a linear
logit the path from the baseline b to the feature z is straight, so IG is weight times (z - b) exactly; the
probability's IG is proportional to it for yes/no labels, and the share of a picture the same. A zero baseline
counts a feature that is large in every picture, whether or not it tells pictures apart; the mean as baseline
does not.
"""

import importlib
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from derender.data import suggestion
from derender.interpretation.probe import Probe

OUTPUTS = ("logit", "probability")
STEPS = {"logit": 2, "probability": 32}  # a logit is linear in the features: any number is exact
NUMBERS_AT_ONCE = 4_000_000


def captum_attr() -> ModuleType:
    """captum's attribution methods, or an error that says how to get them."""
    try:
        return importlib.import_module("captum.attr")
    except ImportError as error:
        raise ValueError(
            f"integrated gradients need the package captum, which is not here ({error}): "
            "pip install 'derender[explain]'"
        ) from error


def integrated_gradients(
    probe: Probe,
    features: np.ndarray,
    target: int,
    *,
    baseline: np.ndarray | None = None,
    output: str = "logit",
    steps: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """What each dimension adds to one answer, from the baseline to the picture.

    Args:
        probe: A answers, D features.
        features: (N, D).
        target: number of the label or class.
        baseline: (D,); zero by default, as in the paper.
        output: "logit" or "probability".
        steps: of the Gauss-Legendre quadrature; by default as many as the output needs.

    Returns:
        (N, D) attributions, and (N,) completeness errors: their sum less the change of the answer.
    """
    if output not in OUTPUTS:
        raise ValueError(
            f"unknown output {output!r}{suggestion(output, OUTPUTS)}; there is {', '.join(OUTPUTS)}"
        )
    if features.ndim != 2 or features.shape[1] != probe.weight.shape[1]:
        raise ValueError(f"the probe takes features (N, {probe.weight.shape[1]}), got {features.shape}")
    together = output == "probability" and probe.kind == "classes"  # only there the other answers matter
    rows = slice(None) if together else slice(target, target + 1)
    weight, bias = (torch.from_numpy(v[rows].astype(np.float64)) for v in (probe.weight, probe.bias))

    def answer(z: Tensor) -> Tensor:
        logits = z @ weight.T + bias
        if output == "logit":
            return logits[:, 0]
        return logits.softmax(dim=1)[:, target] if together else logits[:, 0].sigmoid()

    steps = STEPS[output] if steps is None else steps
    method = captum_attr().IntegratedGradients(answer)
    start = torch.zeros(1, features.shape[1], dtype=torch.float64)
    if baseline is not None:
        start = torch.from_numpy(np.asarray(baseline, np.float64)).reshape(1, -1)
    portion = max(1, NUMBERS_AT_ONCE // (steps * features.shape[1]))
    found, errors = [], []
    for first in range(0, len(features), portion):
        z = torch.from_numpy(features[first : first + portion].astype(np.float64))
        attribution, delta = method.attribute(z, start, n_steps=steps, return_convergence_delta=True)
        found.append(attribution.detach().numpy())
        errors.append(delta.detach().numpy())
    if not found:
        return np.zeros((0, features.shape[1])), np.zeros(0)
    return np.concatenate(found), np.concatenate(errors)


def factor_shares(attributions: np.ndarray, probe: Probe) -> np.ndarray:
    """(N, D) attributions as (N, F) shares of |IG|, which sum to 1; NaN where nothing was attributed."""
    size = np.abs(attributions)
    parts = np.stack([size[:, columns].sum(axis=1) for columns in probe.slices.values()], axis=1)
    total = parts.sum(axis=1, keepdims=True)
    return np.divide(parts, total, out=np.full_like(parts, np.nan), where=total > 0)
