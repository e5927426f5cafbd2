"""Trains a segmentation net on masks, and asks it.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.7: Adam 2e-4 with betas 0.5 and 0.999, 20 epochs. Neither the
loss nor the batch size is stated: cross-entropy, every pixel alike, and 64, that of the paper's other
trainings, or fewer where there are few pictures: in 20 epochs of 80 steps no net learns an eye. Leaves out
augmentation, class weights and early stopping: the last weights are scored.
"""

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import torch
from pydantic import Field
from torch.nn.functional import cross_entropy

from derender.data import as_float
from derender.evaluation.segmentation.pixels import SegmentationData
from derender.networks.unet import SegmentationNet
from derender.settings import Settings
from derender.training.process import freed_memory_kept

LARGEST_BATCH, SMALLEST_BATCH, STEPS_AN_EPOCH = 64, 2, 320

StepProgress = Callable[[int, float], object]
"""Called with (pictures seen, loss) after every step."""


class SegmentSettings(Settings):
    """How a net is trained; without a batch size, ``batch_for`` decides."""

    learning_rate: float = Field(default=2e-4, gt=0)
    betas: tuple[float, float] = (0.5, 0.999)
    epochs: int = Field(default=20, ge=1)
    batch_size: int | None = Field(default=None, ge=2)

    def batch_for(self, pictures: int) -> int:
        """Pictures a step: 64, but fewer (2 at least) where an epoch would have less than 320 steps."""
        return self.batch_size or min(LARGEST_BATCH, max(SMALLEST_BATCH, pictures // STEPS_AN_EPOCH))


def train_segmenter(
    net: SegmentationNet,
    data: SegmentationData,
    seed: int,
    settings: SegmentSettings,
    progress: StepProgress | None = None,
) -> list[float]:
    """Train in place on the training rows; the mean loss of each epoch. The seed orders the pictures."""
    device = next(net.parameters()).device
    net.to(memory_format=torch.channels_last).train()  # pyright: ignore[reportCallIssue]
    learning = [parameter for parameter in net.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam(learning, lr=settings.learning_rate, betas=settings.betas, fused=True)
    generator, seen, means = torch.Generator().manual_seed(seed), 0, []
    batch_size = settings.batch_for(len(data.train))
    with freed_memory_kept() if device.type == "cpu" else nullcontext():
        for _ in range(settings.epochs):
            order = data.train[torch.randperm(len(data.train), generator=generator).numpy()]
            total = 0.0
            for start in range(0, len(order), batch_size):
                rows = order[start : start + batch_size]
                images = as_float(data.images[rows]).to(device, memory_format=torch.channels_last)
                truth = torch.from_numpy(data.masks[rows]).to(device).long()
                loss = cross_entropy(net(images), truth)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                value = loss.item()
                total, seen = total + value * len(rows), seen + len(rows)
                if progress is not None:
                    progress(seen, value)
            means.append(total / len(order))
    return means


@torch.inference_mode()
def answer(net: SegmentationNet, images: np.ndarray, batch_size: int = 128) -> np.ndarray:
    """(N, S, S) uint8: the likeliest class of every pixel of (N, 3, S, S) uint8 pictures."""
    device = next(net.parameters()).device
    net.eval()
    parts = [
        net(as_float(images[start : start + batch_size]).to(device))
        .argmax(dim=1)
        .to(torch.uint8)
        .cpu()
        .numpy()
        for start in range(0, len(images), batch_size)
    ]
    return np.concatenate(parts)
