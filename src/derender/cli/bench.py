"""`derender bench`: speed on this machine, as ratios of two things measured in turns in one run.

Of every pair it is first checked that both compute the same; a pair that does not is an error. Beside them
stands the share of its time that training waits for pictures of a mapped file. Leaves out
peers that are not installed with derender: those are in benchmarks/.
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from derender.cli import options
from derender.cli.console import progress_bar, result, write_json

AGREEMENT = 1e-4


@dataclass(frozen=True)
class Pair:
    """Two ways of the same work, or two kinds of work on the same pictures.

    Attributes:
        what: ours against what.
        unit: what is counted.
        count: how many of these each call does, ours and theirs.
        ours, theirs: the work.
    """

    what: str
    unit: str
    count: tuple[int, int]
    ours: Callable[[], Any]
    theirs: Callable[[], Any]


def register(app: typer.Typer) -> None:
    app.command("bench", epilog="Example: derender bench --quick --json speed.json")(bench)


def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="Smaller sizes and one round: a minute or so.")
    ] = False,
    json_file: options.Json = None,
) -> None:
    """Measure speed on this machine, as ratios: rasteriser, embedding beside training, clustering."""
    rounds = 1 if quick else 5
    pairs = (rasteriser, embedding, clustering)
    rows = []
    with progress_bar("measuring", unit="pairs") as report:
        for done, make in enumerate(pairs):
            rows.append(measured(make(quick), rounds))
            report(done + 1, len(pairs), rows[-1]["what"])
        waited = waiting(quick)
    for row in rows:
        result(
            f"{row['what']}: {row['ratio']:.2f}x ({row['ours_per_second']:,.1f} against "
            f"{row['theirs_per_second']:,.1f} {row['unit']}/s; rounds {row['least']:.2f}..{row['most']:.2f})",
            json_file,
        )
    result(
        f"training, preset small, pictures in a mapped file: {waited['share']:.2%} of "
        f"{waited['seconds']:.1f} s spent waiting for data "
        f"({waited['share_unaided']:.2%} without reading ahead)",
        json_file,
    )
    from derender.training.run_folder import environment

    found = {"rows": rows, "waiting": waited, "machine": environment("cpu")}
    write_json(json_file, {"rounds": rounds, "quick": quick, **found})


def measured(pair: Pair, rounds: int) -> dict[str, Any]:
    """Both in turns, after a round to warm up: medians of speed, and of the ratio least and most."""
    works = ((pair.count[0], pair.ours), (pair.count[1], pair.theirs))
    speeds = [[count / _seconds(work) for count, work in works] for _ in range(rounds + 1)]
    ratios = [ours / theirs for ours, theirs in speeds[1:]]
    ours, theirs = (statistics.median(column) for column in zip(*speeds[1:], strict=True))
    return {
        "what": pair.what,
        "unit": pair.unit,
        "ours_per_second": ours,
        "theirs_per_second": theirs,
        "ratio": statistics.median(ratios),
        "least": min(ratios),
        "most": max(ratios),
    }


def rasteriser(quick: bool) -> Pair:
    """Rendering and its gradient: Numba against plain torch."""
    import torch

    from derender.render import render

    count = 4 if quick else 16
    draw = torch.Generator().manual_seed(0)
    depth = 1 + 0.01 * torch.rand(count, 64, 64, generator=draw)
    albedo = torch.rand(count, 3, 64, 64, generator=draw)
    light = torch.tensor([0.4, 0.6, 0.1, -0.2]).repeat(count, 1)
    camera = torch.zeros(count, 6)
    camera[:, 1] = 0.2

    def work(backend: str) -> tuple[torch.Tensor, torch.Tensor]:
        surface = depth.clone().requires_grad_()
        image = render(surface, albedo, light, camera, fov_deg=10.0, backend=backend).image
        image.square().mean().backward()
        assert surface.grad is not None
        return image.detach(), surface.grad

    _agree("rasterisers", zip(work("numba"), work("reference"), strict=True))
    return Pair(
        "rendering with gradient, 64 px: numba / plain torch", "pictures", (count, count),
        partial(work, "numba"), partial(work, "reference"),
    )  # fmt: skip


def embedding(quick: bool) -> Pair:
    """Embedding against the training step, same networks and pictures."""
    import torch

    from derender.features import embed_images

    count = 8 if quick else 32
    model, step = _training()
    images = torch.rand(count, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    pixels, train = images.numpy(), partial(step, images)
    with torch.no_grad():
        direct = model.embed(images)
    codes = embed_images(model, pixels, batch_size=count)
    _agree("embeddings", ((torch.from_numpy(codes[name]), code) for name, code in direct.items()))
    return Pair(
        "embedding / training step, preset small", "pictures", (count, count),
        partial(embed_images, model, pixels, batch_size=count), train,
    )  # fmt: skip


def clustering(quick: bool) -> Pair:
    """Ward clustering against scikit-learn's."""
    import numpy as np
    from sklearn.cluster import AgglomerativeClustering
    from sklearn.metrics import adjusted_rand_score

    from derender.evaluation.ward import cut, ward_tree

    count = 500 if quick else 3_000
    features = np.random.default_rng(0).normal(size=(count, 128)).astype(np.float32)
    features[: count // 2] += 1
    peer = AgglomerativeClustering(n_clusters=8, linkage="ward")
    same = adjusted_rand_score(peer.fit_predict(features), cut(ward_tree(features), 8))
    if same < 1:
        raise ValueError(f"the two clusterings differ (adjusted Rand index {same:.4f}): nothing was measured")
    return Pair(
        f"Ward clustering of {count:,} rows: derender / scikit-learn", "rows", (count, count),
        lambda: cut(ward_tree(features), 8), partial(peer.fit_predict, features),
    )  # fmt: skip


def waiting(quick: bool) -> dict[str, float]:
    """How much of the time of some training steps goes by until their pictures are there.

    Beside it, from the same file, what reading each batch only when it is needed would take.
    """
    import numpy as np
    import torch

    from derender.training.batches import Batches, Reader

    steps, batch, pictures = (4, 8, 256) if quick else (40, 32, 8_192)
    _, step = _training()
    with tempfile.TemporaryDirectory() as folder:
        file, shape = Path(folder) / "pictures", (pictures, 3, 64, 64)
        file.write_bytes(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8).tobytes())
        images = torch.from_numpy(np.memmap(file, np.uint8, mode="c", shape=shape))
        batches = Batches(images, batch, seed=0, horizontal_flips=True)
        unaided = sum(_seconds(partial(batches.read, position)) for position in range(steps))
        reader = Reader(batches)
        step(reader.at(0))
        before, began = reader.waited_s, time.perf_counter()
        for position in range(1, steps):
            step(reader.at(position))
        took, waited = time.perf_counter() - began, reader.waited_s - before
        reader.close()
        del images, batches, reader  # the file is mapped until nobody holds it
    return {"seconds": took, "share": waited / took, "share_unaided": unaided / (took + unaided)}


def _training() -> tuple[Any, Callable[[Any], None]]:
    """A small model, and a function that takes one training step with pictures but for the update."""
    import torch

    from derender.model import Derenderer
    from derender.training.config import resolve
    from derender.training.step import training_step

    config = resolve("small", ["perceptual=none", "loocc=light+camera"])
    model = Derenderer.seeded(config.model, 0).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def step(images: torch.Tensor) -> None:
        noise = torch.Generator().manual_seed(0)
        training_step(model, images, config.objective, None, noise).total.backward()
        model.zero_grad(set_to_none=True)

    return model, step


def _agree(what: str, pairs: Iterable[tuple[Any, Any]]) -> None:
    for ours, theirs in pairs:
        apart = float((ours - theirs).abs().max()) / max(float(theirs.abs().max()), 1e-12)
        if not apart <= AGREEMENT:
            raise ValueError(
                f"the two {what} differ by {apart:.1e} of the largest value: nothing was measured"
            )


def _seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
