"""A catalogue for Retrieve in Style from an inverted generator and pictures with part masks.

Clusters are found among the activations of random pictures of the generator; the masked pictures, inverted,
say which part each cluster is; the clusters then mark the parts in the random pictures, and the channels are
scored there. Source: Chong et al. (ICCV 2021), where people name the clusters. Leaves out the mathematics
(catalogue.py).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, one_hot

from derender.baselines.model import saved_baseline
from derender.baselines.ris.catalogue import (
    TINY,
    grouped_parts,
    name_clusters,
    nearest_cluster,
    part_energy,
    part_matrix,
    spherical_kmeans,
)
from derender.baselines.ris.model import Ris, RisSettings
from derender.baselines.stylegan2.e4e import E4e, E4eSettings
from derender.baselines.stylegan2.generator import Generator
from derender.baselines.stylegan2.published import load_published_e4e
from derender.data import PictureSet, read_mask_folder, read_masks, split_indices
from derender.settings import Settings
from derender.training.batches import random_stream
from derender.training.loop import SAMPLE_COUNT, Progress, SampleSheet, TrainResult, describe_data
from derender.training.run_folder import append_metrics, start_run

FACE_PARTS = {
    **dict.fromkeys(("l_ear", "r_ear", "ear_r"), "ears"),
    **dict.fromkeys(("l_eye", "r_eye", "l_brow", "r_brow", "eye_g"), "eyes"),
    **dict.fromkeys(("mouth", "u_lip", "l_lip"), "mouth"),
    **dict.fromkeys(("neck", "neck_l", "cloth"), "neck"),
    "hat": "hair",
}
"""CelebAMask-HQ's classes as eight parts; background, skin, hair and nose stay what they are."""
BATCH = 16


class RisConfig(Settings):
    """How a catalogue is made."""

    baseline: Literal["ris"] = "ris"
    e4e: str | None = None  # run folder of an e4e, or a published .pt file
    masks: str | None = None  # folder with a mask for each picture; None: they lie with the pictures
    image_size: int = Field(default=64, ge=32)
    clusters: int = Field(default=18, ge=2)
    cluster_side: int = Field(default=32, ge=4)  # resolution of the activations that are clustered
    samples: int = Field(default=256, ge=2)  # random pictures
    temperature: float = Field(default=0.1, gt=0)
    threshold: float = Field(default=0.8, ge=0, le=1)
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)  # train, validation, test
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True)
class Named:
    """A catalogue whose clusters have parts.

    Attributes:
        model: ready to embed.
        shares: which parts each cluster holds in the masked pictures, rows adding up to 1 (or 0: not seen).
    """

    model: Ris
    shares: Float[Tensor, "k p"]


def clustered_layer(generator: Generator, side: int) -> int:
    """The number of the last style that scales activations of that resolution, or of the largest below it."""
    sizes = [layer.resolution for layer in generator.layers]
    largest = max(size for size in sizes if size <= max(side, min(sizes)))
    return max(number for number, size in enumerate(sizes) if size == largest)


def build_catalogue(
    e4e: E4e,
    images: Float[Tensor, "n 3 h w"],
    parts: Float[Tensor, "n p h w"],
    names: tuple[str, ...],
    config: RisConfig,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Named:
    """Cluster, name and score.

    Args:
        e4e: the inversion and its generator.
        images: pictures in 0..1 at the encoder's size.
        parts: what each pixel of them shows, 1 for one part and 0 for the others.
        names: of the parts.
        config: sizes and the seed.
        progress: called with (pictures done, all).
    """
    net, total = e4e.generator, 2 * config.samples + len(images)
    note = progress or (lambda _done, _total: None)
    layer = clustered_layer(net, config.cluster_side)
    random = random_stream(config.seed, "perturb", 1)
    w = net.mapping(net.random_z(config.samples, random))
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

    energy: list[Tensor | float] = [0.0] * len(net.layers)
    area: list[Tensor | float] = [0.0] * len(net.layers)
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
    scores = torch.cat([torch.as_tensor(e / a) for e, a in zip(energy, area, strict=True)], dim=1)
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
    return Named(model.eval().requires_grad_(False), shares)


@torch.no_grad()
def _activations(net: Generator, w_plus: Float[Tensor, "n codes d"]) -> dict[int, Tensor]:
    """What each style scales, by its number."""
    seen: dict[int, Tensor] = {}
    net.synthesise(net.styles(w_plus), net.fixed_noise(), watch=seen.__setitem__)
    return seen


def open_e4e(source: str | None) -> E4e:
    """The encoder in a run folder, or a published one (a .pt file).

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: no source, damaged, wants to run code, or no e4e.
    """
    if source is None:
        raise ValueError(
            "name the encoder whose generator is catalogued, as in --set e4e=RUN (a run of derender train "
            "--model e4e) or a published file"
        )
    if Path(source).suffix.lower() == ".pt":
        return load_published_e4e(source)
    model = saved_baseline(source, {"e4e": (E4e, E4eSettings)})
    assert isinstance(model, E4e)
    return model


def masked_rows(
    pictures: PictureSet, config: RisConfig
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n p h w"], tuple[str, ...]]:
    """The training part's pictures, their part maps and the parts' names.

    Raises:
        ValueError: the pictures have no masks, or not all.
    """
    size = config.image_size
    if config.masks is None:
        masked = read_masks(pictures.source, size)
    else:
        masked = read_mask_folder(pictures.source, config.masks, size)
    train = split_indices(pictures.files, config.split, seed=config.seed).train
    row_of = {file: row for row, file in enumerate(masked.pictures.files)}
    rows = np.array([row_of[pictures.files[index]] for index in train])
    masks = torch.from_numpy(masked.masks[rows].astype(np.int64))
    parts, names = grouped_parts(masks, masked.classes, FACE_PARTS)
    return torch.from_numpy(masked.pictures.images[rows]).float() / 255, parts, names


def ris_run(
    config: RisConfig,
    pictures: PictureSet,
    out: str | Path,
    *,
    sample_sheet: SampleSheet | None = None,
    progress: Callable[[Progress], None] | None = None,
    accelerator: str = "cpu",
) -> TrainResult:
    """Build a catalogue into a new run folder, which `derender embed --baseline ris` takes; no resume.

    ``sample_sheet`` draws what the finished model makes of a few of the pictures.

    Raises:
        FileExistsError: the folder is not empty.
        ValueError: no encoder was named, or the pictures have no masks.
    """
    e4e = open_e4e(config.e4e).to(accelerator)
    if e4e.image_size != config.image_size:
        raise ValueError(
            f"{config.e4e} takes pictures of {e4e.image_size} pixels: set image_size={e4e.image_size}"
        )
    images, parts, names = masked_rows(pictures, config)
    split = split_indices(pictures.files, config.split, seed=config.seed)
    run = start_run(Path(out), config, describe_data(pictures, split), accelerator)
    began = time.perf_counter()

    def note(done: int, total: int) -> None:
        if progress is not None:
            progress(Progress("train", done, total, done / (time.perf_counter() - began)))

    found = build_catalogue(e4e, images.to(accelerator), parts.to(accelerator), names, config, progress=note)
    seconds, seen = time.perf_counter() - began, len(images)
    model = found.model
    channels = {part: float(model.row(part).gt(0).sum()) for part in model.features}
    append_metrics(run, {"kind": "train", "images": seen, "seconds": round(seconds, 2), **channels})
    model.save(run.model)
    if sample_sheet is not None:
        sheet = sample_sheet(model, images[:SAMPLE_COUNT].to(accelerator))
        sheet.save(run.samples / f"{seen:09d}.png")
    return TrainResult(run.path, seen, seconds, seen / seconds, channels, "images", ())
