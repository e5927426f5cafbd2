"""Reconstruction of held-out pictures: what early stopping and the best checkpoint go by."""

from collections import defaultdict

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from derender.training.batches import random_stream
from derender.training.config import LoopSettings
from derender.training.distributed import ALONE, Ranks
from derender.training.step import Precision
from derender.training.step_module import compute_step

NOT_RECONSTRUCTION = ("l1", "loocc", "cycle")


@torch.no_grad()
def validate(
    module: nn.Module,
    held_out: UInt8[Tensor, "n 3 h w"],
    config: LoopSettings,
    precision: Precision,
    outside_loss: tuple[str, ...] = NOT_RECONSTRUCTION,
    ranks: Ranks = ALONE,
) -> dict[str, float]:
    """Mean losses over held-out pictures; "loss" is the sum of all but those ``outside_loss``.

    Of several ``ranks`` each judges some of the batches, as one process would all of them.
    """
    module.eval()
    sums: dict[str, float] = defaultdict(float)
    count = 0
    for position, batch in enumerate(held_out.split(config.batch_size)):
        if len(batch) < 2 and count:
            break
        count += len(batch)
        if position % ranks.count != ranks.rank:
            continue
        noise = random_stream(config.seed, "perturb", position)
        result = compute_step(module, batch.float() / 255, noise, precision)
        for name, value in result.terms.items():
            sums[name] += value.item() * len(batch)
    module.train()
    means = {name: value / max(count, 1) for name, value in ranks.sum(sums).items()}
    return {"loss": sum(value for name, value in means.items() if name not in outside_loss), **means}
