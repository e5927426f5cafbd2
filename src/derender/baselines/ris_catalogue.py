"""A catalogue for Retrieve in Style from an inverted generator and images with part masks.

Clusters are found among the activations of random images of the generator: spherical k-means of squared
activations of a 32x32 layer. The masked images, inverted, show which part each cluster is; the clusters then
mark the parts in the random images, and the channels are scored there. Source: Chong et al. (ICCV 2021),
where people name the 18 clusters by hand.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Generator as RandomGenerator
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, normalize, one_hot

from derender.baselines.e4e import E4e, open_e4e
from derender.baselines.model import Images
from derender.baselines.ris import Ris, RisConfig, RisSettings, nearest_cluster, part_energy, part_matrix
from derender.baselines.stylegan2_generator import TINY, Generator
from derender.baselines.training import SheetOf, ShortRun
from derender.data import ImageSet, read_masks, split_indices
from derender.training.batches import random_stream
from derender.training.loop import SAMPLE_COUNT
from derender.training.task import TrainResult

FACE_PARTS = {
    **dict.fromkeys(("l_ear", "r_ear", "ear_r"), "ears"),
    **dict.fromkeys(("l_eye", "r_eye", "l_brow", "r_brow", "eye_g"), "eyes"),
    **dict.fromkeys(("mouth", "u_lip", "l_lip"), "mouth"),
    **dict.fromkeys(("neck", "neck_l", "cloth"), "neck"),
    "hat": "hair",
}
"""CelebAMask-HQ's classes as eight parts; background, skin, hair and nose keep their names."""
BATCH = 16


def spherical_kmeans(
    vectors: Float[Tensor, "n c"], clusters: int, generator: RandomGenerator, *, rounds: int = 50
) -> Float[Tensor, "k c"]:
    """Centres of unit length such that rows have large cosines with their nearest one.

    Initial centres are far from each other (as in k-means++); a cluster that loses all rows gets the row that
    is farthest from its own centre. Ends when no row changes its cluster.

    Raises:
        ValueError: there are fewer rows than clusters.
    """
    if len(vectors) < clusters:
        raise ValueError(
            f"{clusters} clusters need at least as many places, got {len(vectors)}: give more images"
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


def clustered_layer(generator: Generator, side: int) -> int:
    """The number of the last style that scales activations of that resolution, or of the largest below it."""
    sizes = [layer.resolution for layer in generator.layers]
    largest = max(size for size in sizes if size <= max(side, min(sizes)))
    return max(number for number, size in enumerate(sizes) if size == largest)


def build_catalogue(
    e4e: E4e,
    images: Images,
    parts: Float[Tensor, "n p h w"],
    names: tuple[str, ...],
    config: RisConfig,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Ris, Float[Tensor, "k p"]]:
    """Cluster, name and score: a model ready to embed, and the share of each part in each cluster.

    Args:
        e4e: the inversion and its generator.
        images: in 0..1 at the encoder's size.
        parts: 1 where a pixel shows the part and 0 elsewhere.
        names: of the parts.
        config: sizes and the seed.
        progress: called with (images done, all).
    """
    net, total = e4e.generator, 2 * config.samples + len(images)
    note = progress or (lambda _done, _total: None)
    layer = clustered_layer(net, config.cluster_side)
    random = random_stream(config.seed, "perturb", 1)
    w = net.random_w(config.samples, random)
    places, done = [], 0
    for batch in w.split(BATCH):
        squared = _activations(net, net.w_plus(batch))[layer].square().movedim(1, -1).flatten(0, 2)
        chosen = torch.randperm(len(squared), generator=random)[: 64 * len(batch)]
        places.append(squared[chosen.to(squared.device)])
        done += len(batch)
        note(done, total)
    centres = spherical_kmeans(torch.cat(places), config.clusters, random)

    clusters = []
    for batch in images.split(BATCH):
        clusters.append(nearest_cluster(_activations(net, e4e.invert(batch))[layer], centres))
        done += len(batch)
        note(done, total)
    at_side = adaptive_avg_pool2d(parts, net.layers[layer].resolution)
    cluster_part, shares = name_clusters(torch.cat(clusters), config.clusters, at_side)

    energy: list[Any] = [0.0] * len(net.layers)
    area: list[Any] = [0.0] * len(net.layers)
    for batch in w.split(BATCH):
        seen = _activations(net, net.w_plus(batch))
        shown = cluster_part[nearest_cluster(seen[layer], centres)]
        masks = one_hot(shown, len(names)).movedim(-1, 1).to(batch)
        for number in range(len(net.layers)):
            more_energy, more_area = part_energy(seen[number], masks)
            energy[number] = energy[number] + more_energy
            area[number] = area[number] + more_area[:, None].clamp(min=TINY)
        done += len(batch)
        note(done, total)
    scores = torch.cat([e / a for e, a in zip(energy, area, strict=True)], dim=1)
    matrix = part_matrix(
        scores, net.layers, names, temperature=config.temperature, threshold=config.threshold
    )
    settings = RisSettings(
        **e4e.settings.model_dump(), parts=names, clusters=config.clusters, cluster_layer=layer
    )
    model = Ris(settings).to(images.device)
    model.e4e.load_state_dict(e4e.state_dict())
    for name, value in (("centres", centres), ("cluster_part", cluster_part), ("matrix", matrix)):
        model.get_buffer(name).copy_(value)
    return model.eval().requires_grad_(False), shares


@torch.no_grad()
def _activations(net: Generator, w_plus: Float[Tensor, "n codes d"]) -> dict[int, Tensor]:
    """The activation that each style scales, by its number."""
    seen: dict[int, Tensor] = {}
    net.synthesise(net.styles(w_plus), net.fixed_noise(), watch=seen.__setitem__)
    return seen


def masked_rows(
    images: ImageSet, config: RisConfig
) -> tuple[Images, Float[Tensor, "n p h w"], tuple[str, ...]]:
    """The training part's images, their part maps and the parts' names.

    Raises:
        ValueError: some images have no masks.
    """
    size = config.image_size
    if config.masks is None:
        masked = read_masks(images.source, size)
    else:
        masked = read_masks(images.source, size, masks=config.masks)
    train = split_indices(images.files, config.split, seed=config.seed).train
    row_of = {file: row for row, file in enumerate(masked.images.files)}
    rows = np.array([row_of[images.files[index]] for index in train])
    masks = torch.from_numpy(masked.masks[rows].astype(np.int64))
    parts, names = grouped_parts(masks, masked.classes, FACE_PARTS)
    return torch.from_numpy(masked.images.images[rows]).float() / 255, parts, names


def train_ris(
    config: RisConfig,
    images: ImageSet,
    out: str | Path,
    *,
    sample_sheet: SheetOf | None = None,
    resume: bool = False,
    accelerator: str = "cpu",
    **how: Any,
) -> TrainResult:
    """Build a catalogue into a new run folder; see `registry.train_baseline`. No resume.

    Raises:
        FileExistsError: the folder is not empty.
        ValueError: no encoder was named, or the images have no masks.
    """
    if config.e4e is None and not resume:
        raise ValueError(
            "name the encoder whose generator is catalogued, as in --set e4e=RUN (a run of derender train "
            "--model e4e) or a published file"
        )
    e4e = open_e4e("e4e", config.e4e).to(accelerator)
    if e4e.image_size != config.image_size:
        raise ValueError(
            f"{config.e4e} takes images of {e4e.image_size} pixels: set image_size={e4e.image_size}"
        )
    inputs, parts, names = (*masked_rows(images, config),)
    run = ShortRun(config, images, out, resume=resume, accelerator=accelerator, **how)
    inputs = inputs.to(accelerator)
    model, _ = build_catalogue(e4e, inputs, parts.to(accelerator), names, config, progress=run.note)
    channels = {part: float(model.row(part).gt(0).sum()) for part in model.features}
    run.record("train", len(inputs), channels)
    if sample_sheet is not None:
        sheet = sample_sheet(Ris.shown)(model, inputs[:SAMPLE_COUNT])
        sheet.save(run.folder.samples / f"{len(inputs):09d}.png")
    return run.finish(model, len(inputs), channels)
