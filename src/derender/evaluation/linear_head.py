"""The paper's linear head: one linear layer, Adam, a hundred epochs; all seeds trained at once.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.4: sigmoid with binary cross-entropy (here also softmax with
cross-entropy for classes), Adam 2e-4, 100 epochs, threshold 0.5. Features enter as they are, not
standardised. The batch size is not stated; 64 is that of the paper's other trainings. With so small a rate
and so few steps the head stays near its random start: it measures the features' scale as much as their
content, which is why the penalised regression (linear_logistic.py) stands beside it. Where the
features' mean lies counts, too: the bias moves by 0.3 at most in 1,600 steps, so on features of mean 0 every
answer begins near one half, while others can lean on their mean to answer with the majority. ``centred``
makes it the same for all.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from derender.settings import Settings


class HeadSettings(Settings):
    """How a head is trained."""

    learning_rate: float = Field(default=2e-4, gt=0)
    epochs: int = Field(default=100, ge=1)
    batch_size: int = Field(default=64, ge=1)


PAPER_HEAD = HeadSettings()


def train_heads(
    features: np.ndarray,
    targets: np.ndarray,
    rows: np.ndarray,
    tested: np.ndarray,
    *,
    kind: str,
    seeds: Sequence[int],
    settings: HeadSettings = PAPER_HEAD,
    centred: bool = False,
    device: str = "cpu",
) -> np.ndarray:
    """Train one head for each seed, all in one program, and ask them: (S, T, A) probabilities.

    Args:
        features: (N, D).
        targets: (N, A) in -1 (unknown, no part in the loss), 0, 1.
        rows: (S, n) training rows of each seed.
        tested: (T,) rows to answer for.
        kind: "labels" or "classes".
        seeds: (S,) for the start and the order of rows.
        settings: of the training.
        centred: take the mean of each seed's training rows from all features first.
        device: where to compute.
    """
    x = torch.from_numpy(np.ascontiguousarray(features, np.float32)).to(device)
    y = torch.from_numpy(np.asarray(targets, np.float32)).to(device)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    weight, bias = (
        torch.stack([start(generator) for generator in generators]).to(device).requires_grad_()
        for start in (_start((x.shape[1], y.shape[1]), x.shape[1]), _start((1, y.shape[1]), x.shape[1]))
    )
    optimiser = torch.optim.Adam([weight, bias], lr=settings.learning_rate)
    chosen = torch.from_numpy(rows)
    nothing = x.new_zeros(1, x.shape[1])
    means = torch.stack(
        [x[own.to(device)].mean(dim=0, keepdim=True) if centred else nothing for own in chosen]
    )
    for _ in range(settings.epochs):
        order = torch.stack(
            [own[torch.randperm(len(own), generator=g)] for own, g in zip(chosen, generators, strict=True)]
        )
        for batch in order.split(settings.batch_size, dim=1):
            batch = batch.to(device)
            loss = head_loss(torch.baddbmm(bias, x[batch] - means, weight), y[batch], kind).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        asked = x[torch.from_numpy(tested).to(device)]
        return np.stack(
            [
                probabilities(torch.addmm(b, asked - mean, w), kind).cpu().numpy()
                for mean, w, b in zip(means, weight, bias, strict=True)
            ]
        )


def head_loss(logits: Tensor, targets: Tensor, kind: str) -> Tensor:
    """Mean loss of each of S heads on (S, B, A) logits: (S,)."""
    if kind == "classes":
        return -(torch.log_softmax(logits, dim=-1) * targets).sum(dim=-1).mean(dim=1)
    known = (targets >= 0).float()
    each = torch.nn.functional.binary_cross_entropy_with_logits(
        logits, targets.clamp(min=0), weight=known, reduction="none"
    )
    return each.sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)


def probabilities(logits: Tensor, kind: str) -> Tensor:
    """Sigmoid of each label, or softmax over the classes."""
    return logits.softmax(dim=-1) if kind == "classes" else logits.sigmoid()


def _start(shape: tuple[int, int], inputs: int) -> Callable[[torch.Generator], Any]:
    """Uniform in +-1/sqrt(inputs), as torch's linear layer starts."""
    return lambda generator: (torch.rand(shape, generator=generator) * 2 - 1) / inputs**0.5
