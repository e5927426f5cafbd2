"""Codes to features: what light and camera move in a code is shrunk, what tells pictures apart is kept; ours.

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
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from derender.whole import whole_file


@dataclass(frozen=True)
class Contrast:
    """An affine map of one factor's codes.

    Attributes:
        mean: what is subtracted first.
        map: multiplied from the right; symmetric, of the rank that was asked for.
        ratios: of every direction, largest first: variance between pictures over variance within them.
    """

    mean: Float[Tensor, " code"]
    map: Float[Tensor, "code code"]
    ratios: Float[Tensor, " code"]


def contrast(codes: Float[Tensor, "views n code"], directions: int, shrinkage: float) -> Contrast:
    """The map that makes the mean variance within pictures 1 in every kept direction.

    Args:
        codes: of ``n`` pictures, each seen ``views`` times.
        directions: how many are kept, those with the largest ratio between over within.
        shrinkage: how much of the mean variance within is added to every direction's, so that a direction
            that hardly moved in these pictures is not taken for one that never moves.

    Raises:
        ValueError: fewer than two views or pictures.
    """
    views, count, size = codes.shape
    if views < 2 or count < 2:
        raise ValueError(f"whitening needs at least 2 views of 2 pictures, got {views} of {count}")
    values = codes.double()
    centres = values.mean(dim=0)
    mean = centres.mean(dim=0)
    within = _covariance((values - centres).flatten(0, 1)) * views / (views - 1)
    between = _covariance(centres - mean)
    floor = within.diagonal().mean().clamp(min=torch.finfo(torch.float32).tiny)
    within = within + shrinkage * floor * torch.eye(size, dtype=values.dtype, device=values.device)
    spread, axes = torch.linalg.eigh(within)
    whiten = axes * spread.clamp(min=torch.finfo(torch.float32).tiny).rsqrt()
    ratios, turn = torch.linalg.eigh(whiten.T @ between @ whiten)
    best = ratios.argsort(descending=True)
    kept = whiten @ turn[:, best[:directions]]
    stretch, basis = torch.linalg.eigh(kept @ kept.T)
    symmetric = (basis * stretch.clamp(min=0).sqrt()) @ basis.T
    return Contrast(mean.float(), symmetric.float(), ratios[best].float())


class Whitening(nn.Module):
    """The maps of some factors, applied to codes by name; factors without one keep their codes."""

    def __init__(self, contrasts: Mapping[str, Contrast]):
        super().__init__()
        self.names = tuple(contrasts)
        for name, found in contrasts.items():
            self.register_buffer(f"{name}_mean", found.mean, persistent=False)
            self.register_buffer(f"{name}_map", found.map, persistent=False)
            self.register_buffer(f"{name}_ratios", found.ratios, persistent=False)

    def forward(self, codes: Mapping[str, Float[Tensor, "n _"]]) -> dict[str, Float[Tensor, "n _"]]:
        return {name: self._whitened(name, code) for name, code in codes.items()}

    def _whitened(self, name: str, code: Float[Tensor, "n code"]) -> Float[Tensor, "n code"]:
        if name not in self.names:
            return code
        return (code.float() - self.get_buffer(f"{name}_mean")) @ self.get_buffer(f"{name}_map")

    def save(self, file: Path) -> None:
        """Write the maps; complete or not at all."""
        tensors = {name: value.detach().cpu().contiguous() for name, value in self.named_buffers()}
        with whole_file(file) as temporary:
            save_file(tensors, temporary)

    @classmethod
    def load(cls, file: Path) -> "Whitening":
        """Read what ``save`` wrote.

        Raises:
            ValueError: tensors are missing or do not fit each other.
        """
        tensors = load_file(file)
        found = {}
        for name in [key.removesuffix("_map") for key in tensors if key.endswith("_map")]:
            try:
                mean, chart, ratios = (
                    tensors[f"{name}_{part}"].float() for part in ("mean", "map", "ratios")
                )
            except KeyError as error:
                raise ValueError(f"it has no {error.args[0]!r}") from error
            if chart.shape != (len(mean), len(mean)) or ratios.shape != mean.shape:
                raise ValueError(f"{name}: a map of {tuple(chart.shape)} beside a mean of {len(mean)}")
            found[name] = Contrast(mean, chart, ratios)
        return cls(found)


def _covariance(centred: Float[Tensor, "n d"]) -> Float[Tensor, "d d"]:
    return centred.T @ centred / len(centred)
