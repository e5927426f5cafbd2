"""Retrieve in Style as a baseline: the style-space code of an image, weighted by each part's row of a matrix.

Source: Chong et al., *Retrieve in Style* (ICCV 2021), after Collins et al., *Editing in Style* (CVPR 2020).
Features of a part are style space times how much of each channel belongs to the part; images are compared by
cosine. With the published FFHQ networks 8 parts have 8 x 9,088 numbers. The image is inverted by e4e.

A channel's score for a part is its squared, instance-normalised activation averaged over the part. A softmax
over parts at temperature 0.1, cut below 0.8, assigns a channel to a part, if to any. Channels that make
colours belong to none; those of the four coarsest layers (2,048 in the published network) rotate the head and
belong to hair alone, the rest of them to the pose. Leaves out the masks that name the parts
(ris_catalogue.py).
"""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float, Int64
from pydantic import Field
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from derender.baselines.e4e import E4e, E4eSettings
from derender.baselines.model import BaselineModel, Images
from derender.baselines.stylegan2_generator import TINY, StyleLayer
from derender.data import suggestion
from derender.settings import Settings

COARSE_LAYERS = 4  # styles at 4 and 8 pixels, before the first that paints 8 pixels' colours
HAIR, POSE = "hair", "pose"


class RisConfig(Settings):
    """How a catalogue is made."""

    baseline: Literal["ris"] = "ris"
    e4e: str | None = None  # run folder of an e4e, or a published .pt file
    masks: str | None = None  # folder with a mask for each image; None: beside the images
    image_size: int = Field(default=64, ge=32)
    clusters: int = Field(default=18, ge=2)
    cluster_side: int = Field(default=32, ge=4)  # resolution of the activations that are clustered
    samples: int = Field(default=256, ge=2)  # random images
    temperature: float = Field(default=0.1, gt=0)
    threshold: float = Field(default=0.8, ge=0, le=1)
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)  # train, validation, test
    seed: int = Field(default=0, ge=0)


class RisSettings(E4eSettings):
    """Sizes of the inversion and of the catalogue, and the parts without the pose."""

    parts: tuple[str, ...] = ("background",)
    clusters: int = Field(default=18, ge=2)
    cluster_layer: int = Field(default=1, ge=0)  # number of the style whose activations are clustered


class Ris(BaselineModel):
    """Inversion, catalogue and matrix. Features: one for every part, and ``pose``; all unless chosen."""

    name, settings_type, config_type = "ris", RisSettings, RisConfig
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

    def styles(self, images: Images) -> Float[Tensor, "n s"]:
        """Style space of images in 0..1."""
        net = self.e4e.generator
        return torch.cat(net.styles(self.e4e.invert(images)), dim=1)

    def row(self, part: str) -> Float[Tensor, " s"]:
        """How much of each style channel belongs to a part, 0..1."""
        if part not in self.features:
            known = ", ".join(self.features)
            raise ValueError(f"no part {part!r}{suggestion(part, self.features)}; there is {known}")
        return self.matrix[self.features.index(part)]

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        styles = self.styles(images)
        return {part: styles * self.row(part) for part in self.features}

    def rebuild(self, styles: Float[Tensor, "n s"]) -> Images:
        """Images, about 0..1, from style space."""
        net = self.e4e.generator
        return net.synthesise(net.split_styles(styles), net.fixed_noise()) / 2 + 0.5

    def swapped(self, images: Images, others: Images, part: str) -> Float[Tensor, "n 3 h2 w2"]:
        """Inversions of images with one part taken from others."""
        own, other = self.styles(images), self.styles(others)
        return self.rebuild(own + self.row(part) * (other - own))

    def shown(self, images: Images, config: Any = None) -> dict[str, Images]:
        side = images.shape[-1]
        columns = {"input": images, "inversion": self.rebuild(self.styles(images))}
        for part in self.features:
            columns[f"{part} of the next"] = self.swapped(images, images.roll(-1, dims=0), part)
        return {name: adaptive_avg_pool2d(column, side).clamp(0, 1) for name, column in columns.items()}


def nearest_cluster(
    activation: Float[Tensor, "n c h w"], centres: Float[Tensor, "k c"]
) -> Int64[Tensor, "n h w"]:
    """The cluster of every place, by the direction of its squared activation."""
    return torch.einsum("nchw,kc->nkhw", activation.square(), centres).argmax(dim=1)


def part_energy(
    activation: Float[Tensor, "n c h w"], parts: Float[Tensor, "n p h2 w2"]
) -> tuple[Float[Tensor, "p c"], Float[Tensor, " p"]]:
    """Summed squared, instance-normalised activation of every channel over every part, and the parts' areas.

    The first over the second is a part's score: 1 on average over all places. The distance from the
    channel's mean is squared: a channel that is on in most of the image scores highest where it is off.
    ``parts`` are shares of every place, at any resolution.
    """
    size = (activation.shape[2], activation.shape[3])
    shrinks = size[0] <= parts.shape[-2]
    at_size = adaptive_avg_pool2d(parts, size) if shrinks else interpolate(parts, size, mode="nearest")
    centred = activation - activation.mean(dim=(2, 3), keepdim=True)
    energy = centred.square() / (centred.square().mean(dim=(2, 3), keepdim=True) + TINY)
    return torch.einsum("nchw,nphw->pc", energy, at_size), at_size.sum(dim=(0, 2, 3))


def part_matrix(
    scores: Float[Tensor, "p s"],
    layers: Sequence[StyleLayer],
    parts: Sequence[str],
    *,
    temperature: float = 0.1,
    threshold: float = 0.8,
) -> Float[Tensor, "p1 s"]:
    """How much of each style channel belongs to each part, 0..1; the last row is the pose.

    Raises:
        ValueError: scores do not fit parts or layers.
    """
    channels = sum(layer.channels for layer in layers)
    if tuple(scores.shape) != (len(parts), channels):
        raise ValueError(
            f"scores of {len(parts)} parts and {channels} style channels expected, got {tuple(scores.shape)}"
        )
    matrix = (scores / temperature).softmax(dim=0)
    matrix = torch.where(matrix >= threshold, matrix, 0.0)
    widths = torch.tensor([layer.channels for layer in layers])
    of_channel = torch.arange(len(layers)).repeat_interleave(widths).to(scores.device)
    coarse = of_channel < COARSE_LAYERS
    colour = torch.tensor([layer.colour for layer in layers], device=scores.device)[of_channel]
    matrix[:, colour] = 0
    for row, part in enumerate(parts):
        if part != HAIR:
            matrix[row, coarse] = 0
    hair = matrix[list(parts).index(HAIR)] if HAIR in parts else torch.zeros_like(matrix[0])
    pose = torch.where(coarse & ~colour, 1 - hair, 0.0)
    return torch.cat([matrix, pose[None]])
