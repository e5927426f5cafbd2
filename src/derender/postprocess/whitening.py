"""Readings to features: what other factors move is shrunk, what tells pictures apart is kept; ours.

Linear discriminant analysis without labels: the classes are pictures, their members the same scene rendered
with this factor left as it is and others changed. Directions in which the renderings of one picture differ
are divided by how much they differ; of the result the directions in which pictures differ most are kept,
counted in units of what those others alone would do, and made more even: a few directions must not drown the
others. Leaves out how the renderings are made (training/features.py).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.storage.atomic import atomic_file
from derender.storage.tensors import read_tensors, write_tensors

_MIRRORED = "reads_mirror_image"  # a file without it is of a model that reads pictures as they are alone
_ALONE = "_alone"  # after a name: this one is read of pictures as they are, though others are not
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


class Spread:
    """How readings differ within pictures and between them, summed up batch by batch.

    Attributes:
        views, count: readings of each picture, and pictures so far.
    """

    def __init__(self) -> None:
        self.views = self.count = 0
        self._within = self._centres = self._centre = torch.zeros((), dtype=torch.float64)

    @classmethod
    def of(cls, readings: Float[Tensor, "views n reading"]) -> "Spread":
        """Of readings that are all there."""
        spread = cls()
        spread.add(readings)
        return spread

    def add(self, readings: Float[Tensor, "views n reading"]) -> None:
        """More pictures, each with as many views as those before."""
        self.views = len(readings)
        self.count += readings.shape[1]
        centres = readings.double().mean(dim=0)
        apart = (readings - centres.to(readings)).flatten(0, 1)
        self._within = self._within + (apart.T @ apart).double()
        self._centres = self._centres + centres.T @ centres
        self._centre = self._centre + centres.sum(dim=0)

    @property
    def mean(self) -> Float[Tensor, " reading"]:
        """Of the pictures' centres."""
        return self._centre / self.count

    @property
    def within(self) -> Float[Tensor, "reading reading"]:
        """Covariance of a picture's readings, the mean over pictures, unbiased."""
        return self._within / (self.count * (self.views - 1))

    @property
    def between(self) -> Float[Tensor, "reading reading"]:
        """Covariance of the pictures' centres."""
        return self._centres / self.count - torch.outer(self.mean, self.mean)


def contrast(
    spread: Spread,
    directions: int,
    shrinkage: float,
    size: int | None = None,
    evenness: float = 0.0,
    power: float = 0.0,
) -> Contrast:
    """The map that makes the mean variance within pictures 1 in every kept direction, or evens out the whole.

    Features are turned so that each is as near as can be to the number of the code in its place, which
    changes no distance.

    Args:
        spread: of readings in which the code stands first.
        directions: how many are kept, those with the largest ratio between over within; at most ``size``.
        shrinkage: how much of the mean variance within is added to every direction's, so that a direction
            that hardly moved in these pictures is not taken for one that never moves.
        size: of the code, and of the features; by default that of the readings.
        evenness: 0..1. At 0 a direction in which pictures differ more counts for more; at 1 all count alike:
            like one in which pictures differ as much as the renderings of one of them do.
        power: of each direction's repeatability, between / (between + within), by which it is weighted: what
            would be expected of the picture itself, at 1 the posterior mean. At 0 all that is kept is alike.

    Raises:
        ValueError: fewer than two views or pictures.
    """
    if spread.views < 2 or spread.count < 2:
        raise ValueError(
            f"whitening needs at least 2 views of 2 pictures, got {spread.views} of {spread.count}"
        )
    mean, within, between = spread.mean, spread.within, spread.between
    width = len(mean)
    size = size or width
    floor = within.diagonal().mean().clamp(min=torch.finfo(torch.float32).tiny)
    within = within + max(shrinkage, _NEVER_SINGULAR) * floor * torch.eye(width).to(within)
    ratios, kept = _most_told_apart(between, within, min(directions, size, width))
    kept = kept * (2 / (1 + ratios)) ** (evenness / 2)  # 1 within and as much between are the 2
    own = ratios.clamp(min=torch.finfo(torch.float32).tiny)
    kept = kept * (own / (1 + own)) ** power
    left, _, right = torch.linalg.svd(kept.T @ (within + between)[:, :size], full_matrices=False)
    return Contrast(mean.float(), (kept @ left @ right).float(), ratios.float())


class Whitening(nn.Module):
    """The maps of some factors, applied to readings by name; gives the features of those factors alone.

    A map of fewer rows than the reading has takes the reading's beginning: the code. Maps of names in
    ``mirrored`` take the mean of a picture's reading and its mirror image's, which follows the first.
    """

    def __init__(self, contrasts: Mapping[str, Contrast], *, mirrored: Collection[str] = ()):
        super().__init__()
        self.names = tuple(contrasts)
        self.mirrored = frozenset(mirrored) & frozenset(contrasts)
        if self.mirrored:
            self.register_buffer(_MIRRORED, torch.ones(1), persistent=False)
        for name, found in contrasts.items():
            if self.mirrored and name not in self.mirrored:
                self.register_buffer(f"{name}{_ALONE}", torch.ones(1), persistent=False)
            self.register_buffer(f"{name}_mean", found.mean, persistent=False)
            self.register_buffer(f"{name}_map", found.map, persistent=False)
            self.register_buffer(f"{name}_ratios", found.ratios, persistent=False)

    def forward(self, readings: Mapping[str, Float[Tensor, "n _"]]) -> dict[str, Float[Tensor, "n _"]]:
        return {name: self._whitened(name, readings[name]) for name in self.names if name in readings}

    def _whitened(self, name: str, reading: Float[Tensor, "n _"]) -> Float[Tensor, "n code"]:
        mean, chart = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_map")
        return (self.taken(name, reading) - mean) @ chart

    def taken(self, name: str, reading: Float[Tensor, "n _"]) -> Float[Tensor, "n taken"]:
        """What the map is applied to: the reading's beginning, or the mean of it and its mirror image's."""
        mean = self.get_buffer(f"{name}_mean")
        mirrored = name in self.mirrored
        wanted = len(mean) * (2 if mirrored else 1)
        if reading.shape[1] < wanted:
            raise ValueError(
                f"features of {name} are made of {wanted:,} numbers, got {reading.shape[1]:,}: "
                "give what model.read gives, not codes"
            )
        if mirrored:
            reading = reading.unflatten(1, (2, -1)).mean(dim=1)
        return reading[:, : len(mean)].float()

    def recentred(self, means: Mapping[str, Float[Tensor, " taken"]]) -> "Whitening":
        """The same maps about other means of what is ``taken``, by name; distances stay as they are."""
        contrasts = {
            name: Contrast(
                means[name].float(), self.get_buffer(f"{name}_map"), self.get_buffer(f"{name}_ratios")
            )
            for name in self.names
        }
        return Whitening(contrasts, mirrored=self.mirrored)

    def tensors(self) -> dict[str, Tensor]:
        """What ``save`` writes, by name."""
        return dict(self.named_buffers())

    def save(self, file: Path) -> None:
        """Write the maps; complete or not at all."""
        with atomic_file(file) as temporary:
            write_tensors(self.tensors(), temporary)

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
        alone = {name for name in found if f"{name}{_ALONE}" in tensors or _MIRRORED not in tensors}
        return cls(found, mirrored=found.keys() - alone)


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
