"""Retrieve in Style as a baseline: the style-space code of an image, weighted by each part's row of a matrix.

Source: Chong et al., *Retrieve in Style* (ICCV 2021), after Collins et al., *Editing in Style* (CVPR 2020).
Features of a part are style space times how much of each channel belongs to the part: 8 x 9,088 numbers with
the published FFHQ networks. Images are compared by cosine and inverted by e4e.

The catalogue: clusters are found among the activations of random images of the generator, by spherical
k-means of squared activations of a 32x32 layer. Images with part masks, inverted, show which part each
cluster is (in the source people name them). The clusters then mark the parts in the random images. A
channel's score for a part is its squared, instance-normalised activation there, averaged. A softmax over
parts at temperature 0.1, cut below 0.8, assigns a channel to a part, if to any. Channels that make colours
belong to none. Those of the four coarsest layers belong to hair alone, the rest of them to the pose.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from pydantic import Field
from torch import Generator as RandomGenerator
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate, normalize, one_hot

from derender.baselines.e4e import E4e, E4eSettings
from derender.baselines.generator import TINY, Codes, Maps, StyleLayer
from derender.baselines.model import BaselineModel, Features, Images, ShortRun
from derender.data import ImageSet, read_masks, split_indices
from derender.settings import Settings
from derender.training.batches import random_stream
from derender.training.loop import SAMPLE_COUNT, SampleSheet
from derender.training.task import TrainResult

COARSE_LAYERS = 4  # styles at 4 and 8 pixels, before the first that paints 8 pixels' colours
HAIR, POSE = "hair", "pose"
FACE_PARTS = {  # CelebAMask-HQ's classes as eight parts; other classes keep their names
    **dict.fromkeys(("l_ear", "r_ear", "ear_r"), "ears"),
    **dict.fromkeys(("l_eye", "r_eye", "l_brow", "r_brow", "eye_g"), "eyes"),
    **dict.fromkeys(("mouth", "u_lip", "l_lip"), "mouth"),
    **dict.fromkeys(("neck", "neck_l", "cloth"), "neck"),
    "hat": "hair",
}
BATCH = 16
Parts = Float[Tensor, "n p h w"]  # how much of each place every part has, 0..1


class RisConfig(Settings):
    """How a catalogue is made."""

    baseline: Literal["ris"] = "ris"
    e4e: str | None = None  # run folder of an e4e
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
    matrix: Tensor  # how much of each style channel belongs to each part, 0..1

    def __init__(self, settings: RisSettings):
        super().__init__(settings)
        self.e4e = E4e(E4eSettings(**settings.model_dump(include=set(E4eSettings.model_fields))))
        self.features = (*settings.parts, POSE)  # pyrefly: ignore[read-only]
        self.chosen = self.features
        widths = [layer.channels for layer in self.e4e.generator.layers]
        self.register_buffer("centres", torch.zeros(settings.clusters, widths[settings.cluster_layer]))
        self.register_buffer("cluster_part", torch.zeros(settings.clusters, dtype=torch.int64))
        self.register_buffer("matrix", torch.zeros(len(self.features), sum(widths)))

    def styles(self, images: Images) -> Float[Tensor, "n s"]:
        """Style space of images in 0..1."""
        return torch.cat([*self.e4e.generator.styles(self.e4e.invert(images))], dim=1)

    def describe(self, images: Images) -> Features:
        styles = self.styles(images)
        return {part: styles * row for part, row in zip(self.features, self.matrix, strict=True)}

    def rebuild(self, styles: Float[Tensor, "n s"]) -> Images:
        """Images, about 0..1, from style space."""
        net = self.e4e.generator
        layers = styles.split([layer.channels for layer in net.layers], dim=1)
        return net.synthesise(layers, net.fixed_noise()) / 2 + 0.5

    def swapped(self, images: Images, others: Images, part: str) -> Float[Tensor, "n 3 h2 w2"]:
        """Inversions of images with one part taken from others."""
        own, other = self.styles(images), self.styles(others)
        return self.rebuild(own + self.matrix[self.features.index(part)] * (other - own))

    def shown(self, images: Images) -> dict[str, Images]:
        columns = {"input": images, "inversion": self.rebuild(self.styles(images))}
        for part in self.features:
            columns[f"{part} of the next"] = self.swapped(images, images.roll(-1, dims=0), part)
        side = images.shape[-1]
        return {name: adaptive_avg_pool2d(column, side).clamp(0, 1) for name, column in columns.items()}

    @classmethod
    def train_into(
        cls, config: RisConfig, images: ImageSet, out: str | Path, *, sample_sheet: SampleSheet | None = None,
        resume: bool = False, accelerator: str = "cpu", **how: Any,
    ) -> TrainResult:  # fmt: skip
        """Build a catalogue into a new run folder; see `train_baseline`. No resume."""
        e4e = E4e.open(config.e4e).to(accelerator)
        if (size := e4e.image_size) != config.image_size:
            raise ValueError(f"{config.e4e} takes images of {size} pixels: set image_size={size}")
        inputs, parts, names = masked_rows(images, config)
        run = ShortRun(config, images, out, resume=resume, accelerator=accelerator, **how)
        inputs, parts = inputs.to(accelerator), parts.to(accelerator)
        model = build_catalogue(e4e, inputs, parts, names, config, progress=run.note)
        channels = dict(zip(model.features, model.matrix.gt(0).sum(dim=1).float().tolist(), strict=True))
        run.record("train", len(inputs), channels)
        if sample_sheet is not None:
            sheet = sample_sheet(model, inputs[:SAMPLE_COUNT])
            sheet.save(run.folder.samples / f"{len(inputs):09d}.png")
        return run.finish(model, len(inputs), channels)


def masked_rows(images: ImageSet, config: RisConfig) -> tuple[Images, Parts, tuple[str, ...]]:
    """The training part's images, a map of 0 and 1 for every part that occurs, and the parts' names."""
    masked = read_masks(images.source, config.image_size, masks=config.masks)
    row_of = {file: row for row, file in enumerate(masked.images.files)}
    train = split_indices(images.files, config.split, seed=config.seed).train
    rows = np.array([row_of[images.files[index]] for index in train])
    masks = torch.from_numpy(masked.masks[rows].astype(np.int64))
    named = [FACE_PARTS.get(name, name) for name in masked.classes]
    present = {named[number] for number in masks.unique().tolist()}
    names = tuple(part for part in dict.fromkeys(named) if part in present)
    table = torch.tensor([[float(part == name) for name in names] for part in named])
    inputs = torch.from_numpy(masked.images.images[rows]).float() / 255
    return inputs, table[masks].movedim(-1, 1), names


def build_catalogue(
    e4e: E4e, images: Images, parts: Parts, names: tuple[str, ...], config: RisConfig, *,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Ris:  # fmt: skip
    """Cluster, name and score: a model ready to embed.

    ``images`` are at the encoder's size. ``parts`` are 1 where a pixel shows the part of that name and 0
    elsewhere. ``progress`` is called with (images done, all).
    """
    net, total, done = e4e.generator, 2 * config.samples + len(images), 0

    def activations(rows: Tensor, to_codes: Callable[[Tensor], Codes]):
        """For each batch of rows, the activation that each style scales."""
        nonlocal done
        for batch in rows.split(BATCH):
            seen: list[Tensor] = []
            with torch.no_grad():
                net.synthesise(net.styles(to_codes(batch)), net.fixed_noise(), seen)
            yield seen
            done += len(batch)
            progress(done, total)

    sides = [layer.resolution for layer in net.layers]  # they grow from 4
    layer = max(number for number, side in enumerate(sides) if side <= config.cluster_side)
    random = random_stream(config.seed, "perturb", 1)
    w, places = net.random_w(config.samples, random), []
    for seen in activations(w, net.w_plus):
        squared = seen[layer].square().movedim(1, -1).flatten(0, 2)
        chosen = torch.randperm(len(squared), generator=random)[: 64 * len(seen[layer])]
        places.append(squared[chosen.to(squared.device)])
    centres = spherical_kmeans(torch.cat(places), config.clusters, random)

    clusters = [nearest_cluster(seen[layer], centres) for seen in activations(images, e4e.invert)]
    shares = adaptive_avg_pool2d(parts, sides[layer])
    cluster_part = name_clusters(torch.cat(clusters), config.clusters, shares)

    energies = []
    for seen in activations(w, net.w_plus):
        shown = cluster_part[nearest_cluster(seen[layer], centres)]
        masks = one_hot(shown, len(names)).movedim(-1, 1).to(w)
        energies.append([part_energy(activation, masks) for activation in seen])
    scores, none = [], torch.zeros(())
    for each in zip(*energies, strict=True):  # each layer's, batch by batch
        scores.append(sum((energy for energy, _ in each), none) / sum((area for _, area in each), none))
    matrix = part_matrix(torch.cat(scores, dim=1), net.layers, names, config.temperature, config.threshold)
    own = {"parts": names, "clusters": config.clusters, "cluster_layer": layer}
    model = Ris(RisSettings(**e4e.settings.model_dump(), **own)).to(images.device)
    model.e4e.load_state_dict(e4e.state_dict())
    model.load_state_dict({"centres": centres, "cluster_part": cluster_part, "matrix": matrix}, strict=False)
    return model.eval().requires_grad_(False)


def spherical_kmeans(
    vectors: Float[Tensor, "n c"], clusters: int, generator: RandomGenerator
) -> Float[Tensor, "k c"]:
    """Centres of unit length such that rows have large cosines with their nearest one.

    Initial centres are far from each other (as in k-means++). A cluster that loses all rows gets the row that
    is farthest from its own centre. Ends when no row changes its cluster, or after 50 rounds.
    """
    if len(vectors) < clusters:
        got = f"got {len(vectors)}: give more images"
        raise ValueError(f"{clusters} clusters need at least as many places, {got}")
    rows = normalize(vectors, dim=1)
    centres = rows[torch.randint(len(rows), (1,), generator=generator).to(rows.device)]
    while len(centres) < clusters:
        far = (1 - (rows @ centres.T).amax(dim=1)).clamp(min=TINY)
        drawn = torch.multinomial(far.cpu(), 1, generator=generator).to(rows.device)
        centres = torch.cat([centres, rows[drawn]])
    assigned = torch.full((len(rows),), -1, device=rows.device)
    for _ in range(50):
        cosine, result = (rows @ centres.T).max(dim=1)
        if torch.equal(result, assigned):
            break
        assigned = result
        sums = torch.zeros_like(centres).index_add_(0, assigned, rows)
        empty = torch.bincount(assigned, minlength=clusters) == 0
        sums[empty] = rows[cosine.argsort()[: int(empty.sum())]]
        centres = normalize(sums, dim=1)
    return centres


def nearest_cluster(activation: Maps, centres: Float[Tensor, "k c"]) -> Int64[Tensor, "n h w"]:
    """The cluster of every place, by the direction of its squared activation."""
    return torch.einsum("nchw,kc->nkhw", activation.square(), centres).argmax(dim=1)


def name_clusters(clusters: Int64[Tensor, "n h w"], count: int, parts: Parts) -> Int64[Tensor, " k"]:
    """The part of each of ``count`` clusters, from ``parts``, their shares of every place.

    The part has the largest share * log(share / the part's share of everything), so that small parts are
    found where they gather. A cluster without places gets the part that has most.
    """
    member, flat = one_hot(clusters, count).flatten(0, 2).to(parts), parts.movedim(1, -1).flatten(0, 2)
    shares = (member.T @ flat) / member.sum(dim=0).clamp(min=1)[:, None]
    overall = flat.mean(dim=0)
    gain = torch.where(shares > 0, shares * (shares / overall.clamp(min=TINY)).clamp(min=TINY).log(), 0.0)
    return torch.where(member.sum(dim=0) == 0, overall.argmax(), gain.argmax(dim=1))


def part_energy(
    activation: Float[Tensor, "n c h w"], parts: Float[Tensor, "n p h2 w2"]
) -> tuple[Float[Tensor, "p c"], Float[Tensor, "p 1"]]:
    """Summed squared, instance-normalised activation of every channel over every part, and the parts' areas.

    The first over the second is a part's score: 1 on average over all places. ``parts`` are shares of every
    place, at any resolution.
    """
    size = (activation.shape[2], activation.shape[3])
    shrinks = size[0] <= parts.shape[-2]
    at_size = adaptive_avg_pool2d(parts, size) if shrinks else interpolate(parts, size, mode="nearest")
    centred = activation - activation.mean(dim=(2, 3), keepdim=True)
    energy = centred.square() / (centred.square().mean(dim=(2, 3), keepdim=True) + TINY)
    return torch.einsum("nchw,nphw->pc", energy, at_size), at_size.sum(dim=(0, 2, 3))[:, None].clamp(min=TINY)


def part_matrix(
    scores: Float[Tensor, "p s"], layers: Sequence[StyleLayer], parts: Sequence[str],
    temperature: float = 0.1, threshold: float = 0.8,
) -> Float[Tensor, "p1 s"]:  # fmt: skip
    """How much of each style channel belongs to each part, 0..1; the last row is the pose."""
    matrix = (scores / temperature).softmax(dim=0)
    matrix = torch.where(matrix >= threshold, matrix, 0.0)
    widths = torch.tensor([layer.channels for layer in layers])
    of_channel = torch.arange(len(layers)).repeat_interleave(widths).to(scores.device)
    coarse = of_channel < COARSE_LAYERS
    colour = torch.tensor([layer.colour for layer in layers], device=scores.device)[of_channel]
    matrix[:, colour] = 0
    is_hair = torch.tensor([part == HAIR for part in parts], device=scores.device)
    matrix[~is_hair[:, None] & coarse] = 0
    pose = torch.where(coarse & ~colour, 1 - matrix[is_hair].sum(dim=0), 0.0)
    return torch.cat([matrix, pose[None]])
