"""Do the maps change with what was learned? Compared with random weights and labels dealt at random.

Source: Adebayo et al., Sanity Checks for Saliency Maps, NeurIPS 2018. A map that stays as it is when the
encoder's weights are drawn anew shows the picture, not the model: it is not to be trusted. One that stays
with labels dealt at random shows what the encoder looks at, whatever is asked. ``another picture`` tells how
much of a map is the same for every picture. Similarity is Spearman's rank correlation over the
places of the map (the verdict goes by it), and SSIM of the maps at the picture's size, each divided by its
largest value.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor

from derender.baselines.controls import untrained_twin
from derender.evaluation.structural_similarity import masked_ssim
from derender.interpretation.cam import METHODS, saliency, to_one, upsampled
from derender.interpretation.probe import Probe

UNCHANGED = 0.5
CHANGES = ("random weights", "shuffled labels", "another picture")


@dataclass(frozen=True)
class Similarity:
    """How alike a method's maps stay when something is changed.

    Attributes:
        method, factor, changed: which maps, and what was changed: one of ``CHANGES``.
        spearman: mean rank correlation over pictures and seeds, -1..1; 1 means unchanged.
        ssim: mean structural similarity, at most 1.
        spread: standard deviation of the rank correlation over pictures and seeds.
        empty: share of comparisons left out because a map was empty or flat.
    """

    method: str
    factor: str
    changed: str
    spearman: float
    ssim: float
    spread: float
    empty: float

    @property
    def trusted(self) -> bool | None:
        """Whether new weights change the map; None where it says nothing of that."""
        if self.changed != "random weights" or not np.isfinite(self.spearman):
            return None
        return self.spearman < UNCHANGED


def sanity_check(
    model: Any,
    probe: Probe,
    shuffled: Probe | None,
    images: Tensor,
    targets: np.ndarray,
    *,
    methods: Sequence[str] = METHODS,
    seeds: Sequence[int] = (0, 1, 2),
) -> list[Similarity]:
    """Compare the maps of a model with those of the same networks with fresh weights, and more.

    Args:
        model: with settings, from which untrained twins are made.
        probe: whose answers are explained; it is kept when weights change.
        shuffled: a probe of labels dealt at random, or None.
        images: (n, 3, s, s) in 0..1, two or more.
        targets: (n,) what is explained of each.
        methods: of ``cam.METHODS``.
        seeds: of the fresh weights.
    """
    if len(images) < 2:
        raise ValueError(f"a sanity check compares maps of 2 pictures or more, got {len(images)}")
    twins = [untrained_twin(model, seed) for seed in seeds]
    found = []
    for method in methods:
        for factor in probe.factors:
            own = saliency(method, model, images, factor, probe, targets)
            others = {
                "random weights": [saliency(method, twin, images, factor, probe, targets) for twin in twins],
                "shuffled labels": []
                if shuffled is None
                else [saliency(method, model, images, factor, shuffled, targets)],
                "another picture": [own.roll(1, dims=0)],
            }
            size = images.shape[-1]
            found += [
                similarity(method, factor, name, own, maps, size) for name, maps in others.items() if maps
            ]
    return found


def similarity(
    method: str, factor: str, changed: str, own: Tensor, others: Sequence[Tensor], size: int
) -> Similarity:
    """Mean similarity of maps (n, y, x) with each of several others of the same pictures."""
    ranks = np.concatenate([spearman(own, other) for other in others])
    ssim = np.concatenate([_ssim(own, other, size) for other in others])
    known = np.isfinite(ranks)
    if not known.any():
        return Similarity(method, factor, changed, float("nan"), float("nan"), float("nan"), 1.0)
    return Similarity(
        method,
        factor,
        changed,
        float(ranks[known].mean()),
        float(ssim[known].mean()),
        float(ranks[known].std()),
        float(1 - known.mean()),
    )


def spearman(first: Tensor, second: Tensor) -> np.ndarray:
    """Rank correlation over the places of each pair of maps, (n,); NaN where one of them is flat."""
    a, b = (rankdata(maps.flatten(1).cpu().double().numpy(), axis=1) for maps in (first, second))
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    length = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return np.divide((a * b).sum(axis=1), length, out=np.full(len(a), np.nan), where=length > 0)


def _ssim(first: Tensor, second: Tensor, size: int) -> np.ndarray:
    one, other = (upsampled(to_one(m), size)[:, None].expand(-1, 3, -1, -1) for m in (first, second))
    everywhere = torch.ones(len(first), size, size, device=first.device)
    return masked_ssim(one, other, everywhere).cpu().numpy()
