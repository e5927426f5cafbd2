"""The images of each batch: a pure function of seed and position, so that a run resumes exactly."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Generator, Tensor

from derender.data.source import evenly_spaced
from derender.training.config import LoopSettings
from derender.training.distributed import ALONE, Ranks

Stored = UInt8[np.ndarray, "n 3 h w"]
Rows = Int64[np.ndarray, " k"]

SAMPLED = 65_536  # images of a memory-mapped set that represent all of them where a few suffice

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
    """Batches of a training set that lies on the device as bytes, or in a file that is mapped into memory."""

    images: UInt8[Tensor, "n 3 h w"]  # (N, 3, H, W) uint8; ``rows`` of them (None: all) are the training set
    batch_size: int  # images in every batch; at most as many as there are
    seed: int  # of the order and the flips
    horizontal_flips: bool  # each image is mirrored with probability one half
    rows: Rows | None = None

    def __post_init__(self) -> None:
        if self.batch_size > len(self):
            more = f"batch_size {self.batch_size} is more than the {len(self)} training images"
            raise ValueError(f"{more}: set batch_size={max(2, len(self) // 2)} or bring more images")

    def __len__(self) -> int:
        return len(self.images) if self.rows is None else len(self.rows)

    def sample(self) -> UInt8[Tensor, "n 3 h w"]:
        """All training images; of a mapped set at most ``SAMPLED``, evenly spread, in memory."""
        if self.rows is None:
            return self.images
        return torch.from_numpy(some_of(self.images.numpy(), self.rows, mapped=True))

    def at(self, position: int, ranks: Ranks = ALONE) -> Float[Tensor, "b 3 h w"]:
        """The batch at a position of the run, from 0 on, in 0..1; of several ``ranks`` each gets its rows."""
        return self.ready(self.read(position, ranks), position, ranks)

    def order(self, position: int, ranks: Ranks = ALONE) -> Int64[Tensor, " b"]:
        """Which images of the training set that batch holds."""
        epoch, within = divmod(position, len(self) // self.batch_size)
        order = _order(len(self), self.seed, epoch)
        return ranks.own(order[within * self.batch_size : (within + 1) * self.batch_size])

    def read(self, position: int, ranks: Ranks = ALONE) -> UInt8[Tensor, "b 3 h w"]:
        """The images of that batch as bytes: the part that may wait for a disk; one thread."""
        rows = self.order(position, ranks)
        if self.images.device.type != "cpu":
            return self.images[rows.to(self.images.device, non_blocking=True)]
        chosen = rows.numpy() if self.rows is None else self.rows[rows.numpy()]
        return torch.from_numpy(np.take(self.images.numpy(), chosen, axis=0))

    def ready(
        self, images: UInt8[Tensor, "b 3 h w"], position: int, ranks: Ranks = ALONE
    ) -> Float[Tensor, "b 3 h w"]:
        """What ``read`` gave for this position as float32 in 0..1, some images mirrored."""
        batch = images.float() / 255
        if self.horizontal_flips:
            flip = torch.rand(self.batch_size, generator=random_stream(self.seed, "flip", position)) < 0.5
            flip = ranks.own(flip).to(batch.device, non_blocking=True)[:, None, None, None]
            batch = torch.where(flip, batch.flip(-1), batch)
        return batch


def batches_of(images: Stored, rows: Rows, config: LoopSettings, device: torch.device) -> Batches:
    """Batches of these rows: on the device, or left in the file where they lie mapped and train on a CPU."""
    stay = isinstance(images, np.memmap) and device.type == "cpu"
    lying = torch.from_numpy(images if stay else np.ascontiguousarray(images[rows])).to(device)
    how = config.batch_size, config.seed, config.horizontal_flips
    return Batches(lying, *how, rows if stay else None)


def some_of(images: Stored, rows: Rows, *, mapped: bool) -> UInt8[np.ndarray, "m 3 h w"]:
    """These images in memory; of a mapped set at most ``SAMPLED``, evenly spread."""
    return np.ascontiguousarray(images[rows[evenly_spaced(len(rows), SAMPLED)] if mapped else rows])


class Reader:
    """Takes batches in order; on a CPU the next one is read in a thread while the present one is computed."""

    def __init__(self, batches: Batches, ranks: Ranks = ALONE):
        self.batches, self.ranks = batches, ranks
        self.waited_s = 0.0  # spent waiting for images, of all batches so far
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="batch")
        self._next: dict[int, Future[Tensor]] = {}

    def at(self, position: int) -> Float[Tensor, "b 3 h w"]:
        """What ``Batches.at`` gives; asked for in order it is there already."""
        began, ahead = time.perf_counter(), self._next.pop(position, None)
        images = self.batches.read(position, self.ranks) if ahead is None else ahead.result()
        self.waited_s += time.perf_counter() - began
        if self.batches.images.device.type == "cpu":
            self._next = {position + 1: self._thread.submit(self.batches.read, position + 1, self.ranks)}
        return self.batches.ready(images, position, self.ranks)

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown(cancel_futures=True)


@lru_cache(maxsize=2)
def _order(count: int, seed: int, epoch: int) -> Tensor:
    """The order of an epoch; a million numbers are not drawn again for every batch of it."""
    return torch.randperm(count, generator=random_stream(seed, "order", epoch))
