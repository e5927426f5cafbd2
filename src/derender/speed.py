"""Speed on this machine, as ratios of two things measured in turns in one run.

Of every pair it is first checked that both compute the same; a pair that does not is an error. Beside them
stands the share of its time that training waits for images of a mapped file. Leaves out peers that are not
installed with derender: those are in benchmarks/.
"""

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import numpy as np
import torch
from sklearn.cluster import AgglomerativeClustering
from sklearn.metrics import adjusted_rand_score
from torch import Tensor

from derender.evaluation.clustering_methods import cut, ward_tree
from derender.features import embed_images
from derender.model import Derenderer
from derender.render import render
from derender.training.batches import Batches, Reader
from derender.training.config import resolve
from derender.training.run_folder import environment
from derender.training.step import training_step


@dataclass(frozen=True)
class SpeedPair:
    """Ours against theirs: what is compared, how many of which unit each call does, and the two calls."""

    what: str
    unit: str
    count: int
    ours: Callable[[], Any]
    theirs: Callable[[], Any]


def bench(quick: bool = False, progress: Callable[..., object] = lambda *_: None) -> dict[str, Any]:
    """Measure the rasteriser, embedding beside training, clustering, and the wait for data.

    Args:
        quick: smaller sizes and one round.
        progress: called with (pairs measured, all, name).

    Returns:
        ``rows`` (see ``measured``), ``waiting`` (see ``waiting_share``), ``machine`` and ``rounds``.
    """
    rounds, rows, pairs = 1 if quick else 5, [], (rasteriser, embedding, clustering)
    for done, make in enumerate(pairs, 1):
        rows.append(measured(make(quick), rounds))
        progress(done, len(pairs), rows[-1]["what"])
    waiting = waiting_share(quick)
    return {"rounds": rounds, "quick": quick, "rows": rows, "waiting": waiting, "machine": environment("cpu")}


def measured(pair: SpeedPair, rounds: int) -> dict[str, Any]:
    """Both in turns, after a round to warm up: medians of speed, and of the ratio least and most."""
    turns = [[timeit(work, number=1) for work in (pair.ours, pair.theirs)] for _ in range(rounds + 1)]
    speeds = pair.count / np.array(turns[1:])
    ours, theirs = np.median(speeds, axis=0).tolist()
    ratio, least, most = np.quantile(speeds[:, 0] / speeds[:, 1], [0.5, 0, 1]).tolist()
    facts = {"what": pair.what, "unit": pair.unit, "ours_per_second": ours, "theirs_per_second": theirs}
    return {**facts, "ratio": ratio, "least": least, "most": most}


def rasteriser(quick: bool) -> SpeedPair:
    """Rendering and its gradient: Numba against plain torch."""
    count, generator = 4 if quick else 16, torch.Generator().manual_seed(0)
    depth = 1 + 0.01 * torch.rand(count, 64, 64, generator=generator)
    albedo = torch.rand(count, 3, 64, 64, generator=generator)
    light = torch.tensor([0.4, 0.6, 0.1, -0.2]).repeat(count, 1)
    camera = torch.tensor([0, 0.2, 0, 0, 0, 0]).repeat(count, 1)

    def work(backend: str) -> tuple[Tensor, Tensor]:
        surface = depth.clone().requires_grad_()
        image = render(surface, albedo, light, camera, fov_deg=10.0, backend=backend).image
        return image.detach(), torch.autograd.grad(image.square().mean(), surface)[0]

    ours, theirs = partial(work, "numba"), partial(work, "reference")
    require_agreement("rasterisers", zip(ours(), theirs(), strict=True))
    return SpeedPair("rendering with gradient, 64 px: numba / plain torch", "images", count, ours, theirs)


def embedding(quick: bool) -> SpeedPair:
    """Embedding against the training step, same networks and images."""
    count, (model, step) = 8 if quick else 32, _training()
    images = torch.rand(count, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    ours = partial(embed_images, model, images.numpy(), batch_size=count)
    with torch.no_grad():
        direct = model.embed(images)
    codes = ours()
    require_agreement("embeddings", ((torch.from_numpy(codes[name]), code) for name, code in direct.items()))
    return SpeedPair("embedding / training step, preset small", "images", count, ours, partial(step, images))


def clustering(quick: bool) -> SpeedPair:
    """Ward clustering against scikit-learn's."""
    count = 500 if quick else 3_000
    features = np.random.default_rng(0).normal(size=(count, 128)).astype(np.float32)
    features[: count // 2] += 1

    theirs = partial(AgglomerativeClustering(n_clusters=8, linkage="ward").fit_predict, features)
    same = adjusted_rand_score(theirs(), cut(ward_tree(features), 8))
    if same < 1:
        raise ValueError(f"the two clusterings differ (adjusted Rand index {same:.4f}): nothing was measured")
    what = f"Ward clustering of {count:,} rows: derender / scikit-learn"
    return SpeedPair(what, "rows", count, lambda: cut(ward_tree(features), 8), theirs)


def waiting_share(quick: bool) -> dict[str, float]:
    """The share of the time of some training steps spent waiting for images, 0..1, and the seconds in all.

    ``share_unaided``: the same if each batch of the mapped file were read only when it is needed.
    """
    steps, batch, count = (4, 8, 256) if quick else (40, 32, 8_192)
    _, step = _training()
    with tempfile.TemporaryDirectory() as folder:
        mapped = np.memmap(Path(folder) / "images", np.uint8, mode="w+", shape=(count, 3, 64, 64))
        mapped[:] = np.random.default_rng(0).integers(0, 256, mapped.shape, dtype=np.uint8)
        images = torch.from_numpy(mapped)
        batches = Batches(images, batch, seed=0, horizontal_flips=True)
        unaided = sum(timeit(partial(batches.read, position), number=1) for position in range(steps))
        reader = Reader(batches)
        step(reader.at(0))
        before = reader.waited_s
        took = sum(timeit(lambda at=at: step(reader.at(at)), number=1) for at in range(1, steps))
        waited = reader.waited_s - before
        reader.close()
        del mapped, images, batches, reader  # the file stays mapped as long as one of them lives
    return {"seconds": took, "share": waited / took, "share_unaided": unaided / (took + unaided)}


def require_agreement(what: str, pairs: Iterable[tuple[Any, Any]]) -> None:
    """Two results that differ by more than 1e-4 of the largest value are an error."""
    for ours, theirs in pairs:
        apart = float((ours - theirs).abs().max()) / max(float(theirs.abs().max()), 1e-12)
        if not apart <= 1e-4:
            raise ValueError(f"the two {what} differ by {apart:.1e} of the largest: nothing was measured")


def _training() -> tuple[Any, Callable[[Any], None]]:
    """A small model, and a function that computes one training step on images without the update."""
    config = resolve("small", ["perceptual=none", "loocc=light+camera"])
    model = Derenderer.seeded(config.model, 0).to(memory_format=torch.channels_last)

    def step(images: Tensor) -> None:
        noise = torch.Generator().manual_seed(0)
        training_step(model, images, config.objective, None, noise).total.backward()
        model.zero_grad(set_to_none=True)

    return model, step
