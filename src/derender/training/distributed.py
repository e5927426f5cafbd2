"""Training on several devices: each has its rows of a batch, and values of all rows are exchanged.

Each rank (one process, one device) takes its rows of every batch. What couples the images of a batch goes
through `Ranks`, with gradient where one is due: a rank's loss is its share of the whole. The mean over ranks
is the loss of the batch, and DDP averages gradients accordingly. Processes are started by torchrun and joined
by Lightning Fabric. Leaves out splitting a model over devices.
"""

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from inspect import signature
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor, distributed
from torch.autograd.function import once_differentiable


@dataclass(frozen=True)
class Ranks:
    """This process, number ``rank`` of ``count`` that train together; all of them call each method."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes files and prints."""
        return self.rank == 0

    def own(self, whole: Shaped[Tensor, "n ..."]) -> Shaped[Tensor, "m ..."]:
        """This rank's rows of a batch."""
        share = len(whole) // self.count
        return whole[self.rank * share : (self.rank + 1) * share]

    def gather(self, piece: Shaped[Tensor, "m ..."]) -> Shaped[Tensor, "n ..."]:
        """The rows of all ranks in order; the gradient of every rank's loss flows back to the owner."""
        if self.count == 1:
            return piece
        half = piece.dtype in (torch.bfloat16, torch.float16)
        gathered: Any = _Gather.apply(piece.float() if half else piece, self)
        return gathered

    def part_of_mean(self, weight: Tensor) -> Tensor:
        """A factor: the mean over ranks of (local mean x this) is the mean over all images, so weighted."""
        if self.count == 1:
            return torch.ones((), device=weight.device)
        local = weight.detach().float().sum()
        total = local.clone()
        distributed.all_reduce(total)
        return torch.where(total > 0, local * self.count / total, torch.zeros_like(total))

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Means over the ranks, by name; all have the same names."""
        return {name: value / self.count for name, value in self.sum(values).items()}

    def sum(self, values: Mapping[str, float]) -> dict[str, float]:
        """Sums over the ranks, by name; one that has nothing to add gives no names."""
        everyone = self._everyone(dict(values))
        names = dict.fromkeys(name for one in everyone for name in one)
        return {name: sum(one.get(name, 0.0) for one in everyone) for name in names}

    def largest(self, *values: float) -> list[float]:
        """Of each number the largest that any rank has."""
        return [max(column) for column in zip(*self._everyone(values), strict=True)]

    def _everyone(self, value: Any) -> list[Any]:
        """The values of all ranks in order."""
        result: list[Any] = [value] * self.count
        if self.count > 1:
            distributed.all_gather_object(result, value)
        return result


ALONE = Ranks()


class _Gather(torch.autograd.Function):
    """All ranks' rows; backward sums the gradients of all ranks for this rank's rows."""

    @staticmethod
    def forward(ctx: Any, piece: Tensor, ranks: Ranks) -> Tensor:
        ctx.ranks = ranks
        pieces = [torch.empty_like(piece, memory_format=torch.contiguous_format) for _ in range(ranks.count)]
        distributed.all_gather(pieces, piece.contiguous())
        return torch.cat(pieces)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyrefly: ignore[bad-override]
        summed = gradient.contiguous().clone()
        distributed.all_reduce(summed)
        return ctx.ranks.own(summed), None


def started_together() -> int:
    """How many processes torchrun started with this one; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1")) if "LOCAL_WORLD_SIZE" in os.environ else 1


def open_fabric(accelerator: str) -> Any:
    """A Lightning Fabric of one device; under torchrun of one for each process, joined when this returns."""
    from lightning_fabric import Fabric
    from lightning_fabric.strategies.ddp import DDPStrategy

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # its hints are not on this program
    world = started_together()
    if world == 1:
        return Fabric(accelerator=accelerator, devices=1)
    known = signature(torch.nn.parallel.DistributedDataParallel.__init__).parameters
    buffers = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
    options: dict[str, Any] = {"find_unused_parameters": True, buffers: False}
    local, strategy = int(os.environ["LOCAL_WORLD_SIZE"]), DDPStrategy(**options)
    fabric = Fabric(accelerator=accelerator, devices=local, num_nodes=world // local, strategy=strategy)
    fabric.launch()
    return fabric


def first_to_fail() -> bool:
    """Whether no other process of this run has failed before: the others then end silently; asked once."""
    if started_together() == 1 or not (distributed.is_available() and distributed.is_initialized()):
        return this_rank_writes()  # before they know of each other all fail alike
    return distributed.distributed_c10d._get_default_store().add("derender/failed", 1) == 1


def leave() -> None:
    """End the connection to the other processes, when all is done."""
    if started_together() > 1 and distributed.is_available() and distributed.is_initialized():
        distributed.destroy_process_group()


def this_rank_writes() -> bool:
    """Whether this process is the one that writes files: the only one, or the first of several."""
    return started_together() == 1 or os.environ.get("RANK", "0") == "0"
