"""The mathematics of Retrieve in Style: clusters of activations, and each channel's share in each part.

Source: Chong et al., *Retrieve in Style* (ICCV 2021), after Collins et al., *Editing in Style* (CVPR 2020).
The squared activations of a 32x32 layer are clustered by direction (spherical k-means), clusters belong to
parts, and a channel's score for a part is its squared, instance-normalised activation averaged over the part.
A softmax over parts at temperature 0.1, cut below 0.8, says which part a channel belongs to, if to any.
Channels that make colours belong to none; those of the four coarsest layers (2,048 in the published network)
turn the head and belong to hair alone, the rest of them to the pose. Where the paper names its 18 clusters by
hand, ours are named by masks. Leaves out what makes the activations.
"""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int64
from torch import Generator, Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate, normalize, one_hot

from derender.baselines.stylegan2.generator import StyleLayer

COARSE_LAYERS = 4  # styles at 4 and 8 pixels, before the first that paints 8 pixels' colours
HAIR, POSE = "hair", "pose"
TINY = 1e-8


def spherical_kmeans(
    vectors: Float[Tensor, "n c"], clusters: int, generator: Generator, *, rounds: int = 50
) -> Float[Tensor, "k c"]:
    """Centres of unit length such that rows have large cosines with their nearest one.

    The first are drawn far from each other (as in k-means++); a cluster that loses all rows is given the row
    that is farthest from its own centre. Ends when no row changes its cluster.

    Raises:
        ValueError: there are fewer rows than clusters.
    """
    if len(vectors) < clusters:
        raise ValueError(
            f"{clusters} clusters need at least as many places, got {len(vectors)}: give more pictures"
        )
    rows = normalize(vectors, dim=1)
    centres = rows[torch.randint(len(rows), (1,), generator=generator).to(rows.device)]
    while len(centres) < clusters:
        far = (1 - (rows @ centres.T).amax(dim=1)).clamp(min=TINY)
        drawn = torch.multinomial(far.cpu(), 1, generator=generator).to(rows.device)
        centres = torch.cat([centres, rows[drawn]])
    assigned = torch.full((len(rows),), -1, device=rows.device)
    for _ in range(rounds):
        cosine, found = (rows @ centres.T).max(dim=1)
        if torch.equal(found, assigned):
            break
        assigned = found
        sums = torch.zeros_like(centres).index_add_(0, assigned, rows)
        empty = torch.bincount(assigned, minlength=clusters) == 0
        sums[empty] = rows[cosine.argsort()[: int(empty.sum())]]
        centres = normalize(sums, dim=1)
    return centres


def nearest_cluster(
    activation: Float[Tensor, "n c h w"], centres: Float[Tensor, "k c"]
) -> Int64[Tensor, "n h w"]:
    """The cluster of every place, by the direction of its squared activation."""
    return torch.einsum("nchw,kc->nkhw", activation.square(), centres).argmax(dim=1)


def name_clusters(
    clusters: Int64[Tensor, "n h w"], count: int, parts: Float[Tensor, "n p h w"]
) -> tuple[Int64[Tensor, " k"], Float[Tensor, "k p"]]:
    """The part of each of ``count`` clusters, and the shares of parts in it.

    ``parts`` are shares of every place. A cluster goes to the part with the largest
    share * log(share / the part's share of everything), so that small parts are found where they gather.
    A cluster without places goes to the part that has most.
    """
    member = one_hot(clusters, count).flatten(0, 2).to(parts)
    flat = parts.movedim(1, -1).flatten(0, 2)
    shares = (member.T @ flat) / member.sum(dim=0).clamp(min=1)[:, None]
    overall = flat.mean(dim=0)
    gain = torch.where(shares > 0, shares * (shares / overall.clamp(min=TINY)).clamp(min=TINY).log(), 0.0)
    unseen = member.sum(dim=0) == 0
    found = torch.where(unseen, overall.argmax(), gain.argmax(dim=1))
    return found, shares


def part_energy(
    activation: Float[Tensor, "n c h w"], parts: Float[Tensor, "n p h2 w2"]
) -> tuple[Float[Tensor, "p c"], Float[Tensor, " p"]]:
    """Summed squared, instance-normalised activation of every channel over every part, and the parts' areas.

    The first over the second is a part's score: 1 on average over all places. What is squared is the distance
    from the channel's mean: one that is on in most of the picture scores highest where it is off. ``parts``
    are shares of every place, at any resolution.
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
    colour, coarse = _marked(layers, scores.device)
    matrix[:, colour] = 0
    for row, part in enumerate(parts):
        if part != HAIR:
            matrix[row, coarse] = 0
    hair = matrix[list(parts).index(HAIR)] if HAIR in parts else torch.zeros_like(matrix[0])
    pose = torch.where(coarse & ~colour, 1 - hair, 0.0)
    return torch.cat([matrix, pose[None]])


def _marked(layers: Sequence[StyleLayer], device: torch.device) -> tuple[Tensor, Tensor]:
    """Which style channels make colours, and which belong to the coarsest layers."""
    widths = torch.tensor([layer.channels for layer in layers])
    colour = torch.tensor([layer.colour for layer in layers]).repeat_interleave(widths)
    coarse = (torch.arange(len(layers)) < COARSE_LAYERS).repeat_interleave(widths)
    return colour.to(device), coarse.to(device)


def transfer(
    own: Float[Tensor, "n s"], other: Float[Tensor, "n s"], row: Float[Tensor, " s"]
) -> Float[Tensor, "n s"]:
    """Style space with one part taken from another picture."""
    return own + row * (other - own)


def grouped_parts(
    masks: Int64[Tensor, "n h w"], classes: Sequence[str], groups: Mapping[str, str]
) -> tuple[Float[Tensor, "n p h w"], tuple[str, ...]]:
    """Masks of class numbers as one map of 0 and 1 for every part that occurs, and the parts' names.

    ``groups`` names the part of a class; a class that it leaves out is a part of its own.
    """
    named = [groups.get(name, name) for name in classes]
    present = {named[number] for number in masks.unique().tolist()}
    parts = tuple(part for part in dict.fromkeys(named) if part in present)
    table = torch.zeros(len(classes), len(parts), device=masks.device)
    for number, part in enumerate(named):
        if part in present:
            table[number, parts.index(part)] = 1
    return table[masks].movedim(-1, 1), parts
