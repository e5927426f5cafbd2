"""Geometry and albedo as a linear model: a mean map, and the directions in which a model's own maps vary.

A morphable model (Blanz and Vetter, SIGGRAPH 1999) whose examples are no scans: they are a trained model's
predictions on unlabelled images, each averaged with its mirror image, for the object is symmetric and the
lighting need not be. A coordinate of 1 is one standard deviation of them. Leaves out differences between the
sides, and everything a decoder can predict that is far from the mean.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn


class MorphableMaps(nn.Module):
    """Coordinates to maps and back, by name.

    Args:
        means: by name, a map of any shape.
        axes: by name, (coordinates, *shape of the map): what a coordinate of 1 adds; at right angles.
    """

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
        """The directions in which examples vary most, at most as many as differ; same maps, same model.

        Args:
            examples: by name, maps; what their mirror images (along the last axis) share with them counts.
            coordinates: of each name.

        Raises:
            ValueError: fewer than two examples.
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
        found = (maps - mean).flatten(1) @ axes.T
        return torch.where(squared > 0, found / squared.clamp(min=torch.finfo(squared.dtype).tiny), 0.0)


def _principal(centred: Float[Tensor, "n d"], count: int) -> tuple[Float[Tensor, " k"], Float[Tensor, "k d"]]:
    """The largest principal components: standard deviations and directions, by the smaller Gram matrix."""
    from scipy.linalg import eigh  # only the largest: torch would find all

    rows, columns = centred.shape
    count = min(count, rows, columns)
    wide = columns > rows
    gram = (centred @ centred.T if wide else centred.T @ centred).double().cpu().numpy()
    found = eigh(gram, subset_by_index=[len(gram) - count, len(gram) - 1])
    variances, vectors = (torch.from_numpy(part.copy()).flip(-1) for part in found)
    directions = vectors.T.to(centred)
    if wide:
        directions = directions @ centred
    length = directions.norm(dim=1, keepdim=True)
    distinct = (variances > variances.max() * 1e-10).to(centred)[:, None]
    directions = directions / length.clamp(min=torch.finfo(centred.dtype).tiny) * distinct
    return (variances.clamp(min=0) / rows).sqrt().to(centred), directions
