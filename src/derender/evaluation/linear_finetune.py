"""The paper's head trained together with the encoders under it.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.4 and Table 2 ("Finetune"). Encoders and head share Adam 2e-4,
100 epochs and batches of 64, as the frozen head; the paper does not say whether the encoders had a rate of
their own. An untrained model under the same protocol is the control: a supervised training from nothing.
Leaves out the rendering objective beside the task.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from derender.data import as_float
from derender.evaluation.linear_head import PAPER_HEAD, HeadSettings, head_loss, probabilities
from derender.evaluation.linear_task import Task

Progress = Callable[[int, int], object]


def finetune(
    model: Any,
    images: np.ndarray,
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    *,
    factors: Sequence[str] = ("geometry", "albedo"),
    seed: int = 0,
    settings: HeadSettings = PAPER_HEAD,
    progress: Progress | None = None,
) -> np.ndarray:
    """Train copies of the encoders with a new head, answer for the test rows: (T, A) probabilities.

    The model itself stays as it was.

    Args:
        model: with ``nets[factor].encode`` and ``device``.
        images: (N, 3, H, W) uint8.
        task: what is asked of the N pictures.
        rows: (n,) training rows.
        tested: (T,) rows to answer for.
        factors: whose encoders.
        seed: of the head's start and the order of pictures.
        settings: of the training.
        progress: called with (epochs done, epochs in all).
    """
    device = model.device
    nets = nn.ModuleDict({name: copy.deepcopy(model.nets[name]) for name in factors}).to(device)
    nets.requires_grad_(True).train()

    def embed(numbers: np.ndarray) -> torch.Tensor:
        pictures = as_float(np.ascontiguousarray(images[numbers])).to(device)
        return torch.cat([nets[name].encode(pictures) for name in factors], dim=1)  # type: ignore[operator]

    generator = torch.Generator().manual_seed(seed)
    targets = torch.from_numpy(task.targets).float().to(device)
    with torch.no_grad():
        width = embed(rows[:1]).shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = nn.Linear(width, targets.shape[1]).to(device)
    optimiser = torch.optim.Adam([*nets.parameters(), *head.parameters()], lr=settings.learning_rate)
    for epoch in range(settings.epochs):
        order = rows[torch.randperm(len(rows), generator=generator).numpy()]
        for start in range(0, len(order), settings.batch_size):
            batch = order[start : start + settings.batch_size]
            loss = head_loss(head(embed(batch))[None], targets[batch][None], task.kind).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        if progress is not None:
            progress(epoch + 1, settings.epochs)
    nets.eval()
    with torch.inference_mode():
        parts = np.array_split(tested, max(1, len(tested) // 256))
        return np.concatenate([probabilities(head(embed(part)), task.kind).cpu().numpy() for part in parts])
