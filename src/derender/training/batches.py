"""Which pictures make up each batch: a pure function of seed and position, so that a run resumes exactly."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Generator, Tensor

from derender.training.distributed import ALONE, Ranks

_STREAMS = {"order": 1, "flip": 2, "perturb": 3}


def random_stream(seed: int, purpose: str, position: int) -> Generator:
    """A generator for one purpose at one position of a run, independent of every other."""
    mixed = 0x9E3779B97F4A7C15
    for word in (seed, _STREAMS[purpose], position):
        mixed = ((mixed ^ word) * 0xBF58476D1CE4E5B9) % 2**64
        mixed ^= mixed >> 31
    return Generator().manual_seed(mixed % 2**63)


@dataclass(frozen=True)
class Batches:
    """Batches of a training set that lies on the device as bytes.

    Attributes:
        images: (N, 3, H, W) uint8.
        batch_size: pictures in every batch; at most N.
        seed: of the order and the flips.
        horizontal_flips: whether each picture is mirrored with probability one half.
    """

    images: UInt8[Tensor, "n 3 h w"]
    batch_size: int
    seed: int
    horizontal_flips: bool

    def __post_init__(self) -> None:
        if self.batch_size > len(self.images):
            raise ValueError(
                f"batch_size {self.batch_size} is more than the {len(self.images)} training pictures: "
                f"set batch_size={max(2, len(self.images) // 2)} or bring more pictures"
            )

    def at(self, position: int, ranks: Ranks = ALONE) -> Float[Tensor, "b 3 h w"]:
        """The batch at a position of the run, counted in batches from 0, as float32 in 0..1.

        Of several ``ranks`` each gets its own rows of the batch that one process would get.
        """
        per_epoch = len(self.images) // self.batch_size
        epoch, within = divmod(position, per_epoch)
        order = torch.randperm(len(self.images), generator=random_stream(self.seed, "order", epoch))
        rows = ranks.own(order[within * self.batch_size : (within + 1) * self.batch_size])
        batch = self.images[rows.to(self.images.device)].float() / 255
        if self.horizontal_flips:
            flip = torch.rand(self.batch_size, generator=random_stream(self.seed, "flip", position)) < 0.5
            flip = ranks.own(flip)
            batch = torch.where(flip.to(batch.device)[:, None, None, None], batch.flip(-1), batch)
        return batch
