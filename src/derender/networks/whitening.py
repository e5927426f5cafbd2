"""Readings to features: what light and camera move is shrunk, what tells pictures apart is kept; ours.

Linear discriminant analysis without labels: the classes are pictures, their members the same scene rendered
in other light and from other sides. Directions in which the renderings of one picture differ are divided by
how much they differ; of the result the directions in which pictures differ most are kept. Distances between
features are then counted in units of what light and camera alone would do. Leaves out how the renderings are
made (training/whitening.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.networks.tensor_file import read_tensors, write_tensors
from derender.whole import whole_file

_NEVER_SINGULAR = 1e-9  # share of the mean variance that is added at least: Cholesky's root must exist


@dataclass(frozen=True)
class Contrast:
    """An affine map of one factor's readings.

    Attributes:
        mean: what is subtracted first.
        map: multiplied from the right; of the rank that was asked for.
        ratios: of every kept direction, largest first: variance between pictures over variance within them.
    """

    mean: Float[Tensor, " reading"]
    map: Float[Tensor, "reading code"]
    ratios: Float[Tensor, " directions"]


def contrast(
    readings: Float[Tensor, "views n reading"], directions: int, shrinkage: float, size: int | None = None
) -> Contrast:
    """The map that makes the mean variance within pictures 1 in every kept direction.

    Features are turned so that each is as near as can be to the number of the code in its place, which
    changes no distance.

    Args:
        readings: of ``n`` pictures, each seen ``views`` times; the code stands first.
        directions: how many are kept, those with the largest ratio between over within; at most ``size``.
        shrinkage: how much of the mean variance within is added to every direction's, so that a direction
            that hardly moved in these pictures is not taken for one that never moves.
        size: of the code, and of the features; by default that of the readings.

    Raises:
        ValueError: fewer than two views or pictures.
    """
    views, count, width = readings.shape
    size = size or width
    if views < 2 or count < 2:
        raise ValueError(f"whitening needs at least 2 views of 2 pictures, got {views} of {count}")
    values = readings.double()
    centres = values.mean(dim=0)
    mean = centres.mean(dim=0)
    within = _covariance((values - centres).flatten(0, 1)) * views / (views - 1)
    between = _covariance(centres - mean)
    floor = within.diagonal().mean().clamp(min=torch.finfo(torch.float32).tiny)
    within = within + max(shrinkage, _NEVER_SINGULAR) * floor * torch.eye(
        width, dtype=values.dtype, device=values.device
    )
    ratios, kept = _most_told_apart(between, within, min(directions, size, width))
    left, _, right = torch.linalg.svd(kept.T @ (within + between)[:, :size], full_matrices=False)
    return Contrast(mean.float(), (kept @ left @ right).float(), ratios.float())


class Whitening(nn.Module):
    """The maps of some factors, applied to readings by name; gives the features of those factors alone.

    A map of fewer rows than the reading has takes the reading's beginning: the code.
    """

    def __init__(self, contrasts: Mapping[str, Contrast]):
        super().__init__()
        self.names = tuple(contrasts)
        for name, found in contrasts.items():
            self.register_buffer(f"{name}_mean", found.mean, persistent=False)
            self.register_buffer(f"{name}_map", found.map, persistent=False)
            self.register_buffer(f"{name}_ratios", found.ratios, persistent=False)

    def forward(self, readings: Mapping[str, Float[Tensor, "n _"]]) -> dict[str, Float[Tensor, "n _"]]:
        return {name: self._whitened(name, readings[name]) for name in self.names if name in readings}

    def _whitened(self, name: str, reading: Float[Tensor, "n _"]) -> Float[Tensor, "n code"]:
        mean, chart = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_map")
        if reading.shape[1] < len(mean):
            raise ValueError(
                f"features of {name} are made of {len(mean):,} numbers, got {reading.shape[1]:,}: "
                "give what model.read gives, not codes"
            )
        return (reading[:, : len(mean)].float() - mean) @ chart

    def save(self, file: Path) -> None:
        """Write the maps; complete or not at all."""
        with whole_file(file) as temporary:
            write_tensors(dict(self.named_buffers()), temporary)

    @classmethod
    def load(cls, file: Path) -> "Whitening":
        """Read what ``save`` wrote.

        Raises:
            ValueError: it is damaged, or tensors are missing or do not fit each other.
        """
        tensors = read_tensors(file)
        found = {}
        for name in [key.removesuffix("_map") for key in tensors if key.endswith("_map")]:
            try:
                mean, chart, ratios = (
                    tensors[f"{name}_{part}"].float() for part in ("mean", "map", "ratios")
                )
            except KeyError as error:
                raise ValueError(f"it has no {error.args[0]!r}") from error
            if chart.ndim != 2 or len(chart) != len(mean) or ratios.ndim != 1:
                raise ValueError(f"{name}: a map of {tuple(chart.shape)} beside a mean of {len(mean)}")
            found[name] = Contrast(mean, chart, ratios)
        return cls(found)


def _most_told_apart(between: Tensor, within: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The largest ratios of two covariances and their directions (reading, count), of variance 1 within."""
    from scipy.linalg import (
        eigh,
    )  # only the directions that are kept: torch would find all, three times as slow

    width = len(within)
    ratios, directions = eigh(
        between.cpu().numpy(), within.cpu().numpy(), subset_by_index=[width - count, width - 1]
    )
    return tuple(torch.from_numpy(found.copy()).to(within).flip(-1) for found in (ratios, directions))  # type: ignore[return-value]


def _covariance(centred: Float[Tensor, "n d"]) -> Float[Tensor, "d d"]:
    return centred.T @ centred / len(centred)
