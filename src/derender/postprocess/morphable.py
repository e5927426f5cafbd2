"""Geometry and albedo as a linear model: a mean map, and the directions in which a model's own maps vary.

A morphable model (Blanz and Vetter, SIGGRAPH 1999) whose examples are a trained model's predictions. Each is
averaged with its mirror image, for the object is symmetric. A coordinate of 1 is one standard deviation.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn


class MorphableMaps(nn.Module):
    """Coordinates to maps and back, by name: a mean, and what a coordinate of 1 of each axis adds to it."""

    def __init__(self, means: Mapping[str, Tensor], axes: Mapping[str, Tensor]):
        super().__init__()
        self.names = tuple(means)
        for name in self.names:
            if axes[name].shape[1:] != means[name].shape:
                raise ValueError(
                    f"{name}: axes of {tuple(axes[name].shape[1:])} beside a mean of "
                    f"{tuple(means[name].shape)}"
                )
            self.register_buffer(f"{name}_mean", means[name].float(), persistent=False)
            self.register_buffer(f"{name}_axes", axes[name].float(), persistent=False)

    @classmethod
    def of(cls, examples: Mapping[str, Float[Tensor, "n ..."]], coordinates: int) -> "MorphableMaps":
        """The directions in which maps vary most, by name, at most as many as differ; same maps, same model.

        What the mirror images (along the last axis) share with them counts. Fewer than two are a ValueError.
        """
        means, axes = {}, {}
        for name, maps in examples.items():
            if len(maps) < 2:
                raise ValueError(f"a morphable model needs 2 examples or more, got {len(maps)}")
            both = ((maps + maps.flip(-1)) / 2).flatten(1).float()
            mean = both.mean(dim=0)
            deviations, directions = _principal(both - mean, min(coordinates, len(maps) - 1))
            means[name] = mean.reshape(maps.shape[1:])
            axes[name] = (directions * deviations[:, None]).reshape(-1, *maps.shape[1:])
        return cls(means, axes)

    def size(self, name: str) -> int:
        """How many coordinates a name has."""
        return len(self.get_buffer(f"{name}_axes"))

    def maps(self, name: str, coordinates: Float[Tensor, "n k"]) -> Float[Tensor, "n ..."]:
        """The maps that coordinates stand for."""
        mean, axes = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_axes")
        return mean + (coordinates @ axes.flatten(1)).unflatten(1, mean.shape)

    def coordinates(self, name: str, maps: Float[Tensor, "n ..."]) -> Float[Tensor, "n k"]:
        """Of the nearest map the model has; an axis without length has coordinate 0."""
        mean, axes = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_axes").flatten(1)
        squared = axes.square().sum(dim=1)
        result = (maps - mean).flatten(1) @ axes.T
        return torch.where(squared > 0, result / squared.clamp(min=torch.finfo(squared.dtype).tiny), 0.0)


def _principal(centred: Float[Tensor, "n d"], count: int) -> tuple[Float[Tensor, " k"], Float[Tensor, "k d"]]:
    """The largest principal components: standard deviations and directions, by the smaller Gram matrix."""
    from scipy.linalg import eigh  # only the largest: torch would find all

    rows, columns = centred.shape
    count = min(count, rows, columns)
    wide = columns > rows
    gram = (centred @ centred.T if wide else centred.T @ centred).double().cpu().numpy()
    result = eigh(gram, subset_by_index=[len(gram) - count, len(gram) - 1])
    variances, vectors = (torch.from_numpy(part.copy()).flip(-1) for part in result)
    directions = vectors.T.to(centred)
    if wide:
        directions = directions @ centred
    length = directions.norm(dim=1, keepdim=True)
    distinct = (variances > variances.max() * 1e-10).to(centred)[:, None]
    directions = directions / length.clamp(min=torch.finfo(centred.dtype).tiny) * distinct
    return (variances.clamp(min=0) / rows).sqrt().to(centred), directions
