"""Retrieve in Style as a baseline: a picture's style-space code, seen through each part's row of the matrix.

Source: Chong et al. (ICCV 2021): features of a part are style space times how much of each channel belongs to
the part; pictures are compared by cosine. With the published FFHQ networks 8 parts have 8 x 9,088 numbers.
The picture is inverted by e4e. Leaves out how the matrix is made (building.py).
"""

import torch
from jaxtyping import Float, Int64
from pydantic import Field
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from derender.baselines.model import BaselineModel
from derender.baselines.ris.catalogue import POSE, nearest_cluster, transfer
from derender.baselines.stylegan2.e4e import E4e, E4eSettings
from derender.data import suggestion


class RisSettings(E4eSettings):
    """The inversion's sizes, the parts without the pose, and the catalogue's size."""

    parts: tuple[str, ...] = ("background",)
    clusters: int = Field(default=18, ge=2)
    cluster_layer: int = Field(default=1, ge=0)  # number of the style whose activations are clustered


class Ris(BaselineModel):
    """Inversion, catalogue and matrix. Features: one for every part, and ``pose``; all unless chosen."""

    name = "ris"
    features = (POSE,)
    settings: RisSettings
    centres: Tensor
    cluster_part: Tensor
    matrix: Tensor

    def __init__(self, settings: RisSettings):
        super().__init__(settings)
        own = set(RisSettings.model_fields) - set(E4eSettings.model_fields)
        self.e4e = E4e(E4eSettings(**settings.model_dump(exclude=own)))
        self.features = (*settings.parts, POSE)  # pyright: ignore[reportAttributeAccessIssue]
        self.chosen = self.features
        layers = self.e4e.generator.layers
        width = layers[settings.cluster_layer].channels
        self.register_buffer("centres", torch.zeros(settings.clusters, width))
        self.register_buffer("cluster_part", torch.zeros(settings.clusters, dtype=torch.int64))
        channels = sum(layer.channels for layer in layers)
        self.register_buffer("matrix", torch.zeros(len(self.features), channels))

    def styles(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n s"]:
        """Style space of pictures in 0..1."""
        net = self.e4e.generator
        return torch.cat(net.styles(self.e4e.invert(images)), dim=1)

    def row(self, part: str) -> Float[Tensor, " s"]:
        """How much of each style channel belongs to a part, 0..1."""
        if part not in self.features:
            known = ", ".join(self.features)
            raise ValueError(f"no part {part!r}{suggestion(part, self.features)}; there is {known}")
        return self.matrix[self.features.index(part)]

    def describe(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        styles = self.styles(images)
        return {part: styles * self.row(part) for part in self.chosen}

    def rebuild(self, styles: Float[Tensor, "n s"]) -> Float[Tensor, "n 3 h w"]:
        """Pictures, about 0..1, from style space."""
        net = self.e4e.generator
        return net.synthesise(net.split_styles(styles), net.fixed_noise()) / 2 + 0.5

    def swapped(
        self, images: Float[Tensor, "n 3 h w"], others: Float[Tensor, "n 3 h w"], part: str
    ) -> Float[Tensor, "n 3 h2 w2"]:
        """Inversions of pictures with one part taken from others."""
        return self.rebuild(transfer(self.styles(images), self.styles(others), self.row(part)))

    def segment(self, images: Float[Tensor, "n 3 h w"]) -> Int64[Tensor, "n r r"]:
        """The part of every place of the inversion, by the catalogue: numbers into ``settings.parts``."""
        net, seen = self.e4e.generator, {}
        styles = net.split_styles(self.styles(images))
        net.synthesise(styles, net.fixed_noise(), watch=seen.__setitem__)
        clusters = nearest_cluster(seen[self.settings.cluster_layer], self.centres)
        return self.cluster_part[clusters]

    def shown(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n 3 h w"]]:
        side = images.shape[-1]
        columns = {"input": images, "inversion": self.rebuild(self.styles(images))}
        for part in self.features:
            columns[f"{part} of the next"] = self.swapped(images, images.roll(-1, dims=0), part)
        return {name: adaptive_avg_pool2d(column, side).clamp(0, 1) for name, column in columns.items()}
