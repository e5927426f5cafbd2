"""A trial of real pictures that a model takes apart and renders again in other light and from other sides.

Everything is a rendering, what is learned from too (each scene in its own light and from its own side), so
that no curve starts with the step from photograph to rendering. Angles are the model's own: nobody knows
those of a photograph. Where its geometry is wrong the renderings are, and the model that rendered them has an
easier time with them than others: read it beside generated pictures. Pixels that no surface covers take the
mean colour of the picture's edge, by the rule of training.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from derender.data import PictureSet
from derender.evaluation.linear_task import Task
from derender.evaluation.memory import Memory
from derender.evaluation.robustness.axes import Axis, checked_levels, either_side
from derender.evaluation.robustness.trial import Curve, Trial
from derender.features import map_batches, missing, model_fingerprint
from derender.training.step import fill_uncovered

Progress = Callable[[int, int], object]


def rendered_trial(
    model: Any,
    pictures: PictureSet,
    task: Task,
    learn: np.ndarray,
    test: np.ndarray,
    axes: Sequence[Axis],
    levels: Sequence[float],
    *,
    groups: np.ndarray | None = None,
    batch_size: int = 64,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> Trial:
    """Render the pictures, or find them where the same model rendered the same before.

    Args:
        model: with ``decompose``, ``render``, ``device``.
        pictures: at the model's size.
        task: what is asked of each picture.
        learn, test: rows of the pictures that are learned from and tested.
        axes, levels: what is turned, and how far (degrees).
        groups: (N,) labels whose pictures are resampled together, such as identities; a picture without
            one, and all where no groups are given, by itself.
        batch_size: pictures at a time; changes speed and memory only.
        memory: where renderings are kept.
        progress: called with (pictures taken apart, pictures in all).
    """
    levels = checked_levels(levels, axes)
    asked = [(axis, angle) for axis in axes for level in levels for angle in either_side(level)]
    rows = np.concatenate((learn, test))
    inputs = {
        "weights": model_fingerprint(model), "images": pictures.images[rows], "n_learn": len(learn),
        "asked": [[axis.name, angle] for axis, angle in asked],
    }  # fmt: skip

    def make() -> dict[str, np.ndarray]:
        plain = _rendered(model, pictures.images[rows], [None], batch_size, progress)[0]
        turned = _rendered(model, pictures.images[test], asked, batch_size, progress)
        return {"images": np.concatenate((plain, *turned))}

    images = (memory or Memory()).recall("rendered", inputs, make)["images"]
    shown = np.concatenate((rows, np.tile(test, len(asked))))
    number = np.arange(len(pictures)) if groups is None else _numbered(groups)
    ordinary = len(learn) + np.arange(len(test))
    curves, at = [], len(rows)
    for axis in axes:
        tested = []
        for level in levels:
            count = len(test) * len(either_side(level))
            tested.append(at + np.arange(count))
            at += count
        curves.append(Curve(axis.name, axis.title, np.arange(len(learn)), ordinary, levels, tuple(tested)))
    asked_of = Task(task.kind, task.names, task.targets[shown])
    how = f"pictures of {pictures.layout} rendered again"
    return Trial(
        images, asked_of, number[shown].astype(np.int64), tuple(curves), how, int((~task.known).sum())
    )


def _numbered(groups: np.ndarray) -> np.ndarray:
    """(N,) numbers of the groups; a row without one has its own number, as it stands alone in the split."""
    alone = missing(groups)
    found = np.unique(groups.astype(str), return_inverse=True)[1]
    found[alone] = len(found) + np.flatnonzero(alone)
    return found


def _rendered(
    model: Any,
    images: np.ndarray,
    asked: Sequence[tuple[Axis, float] | None],
    batch_size: int,
    progress: Progress | None,
) -> list[np.ndarray]:
    """For every angle asked for (None: as it is), (N, 3, S, S) uint8."""

    def render(batch: torch.Tensor) -> list[np.ndarray]:
        scene, found = model.decompose(batch), []
        for one in asked:
            rendering = model.render(scene if one is None else one[0].turned(scene, one[1]))
            shown = fill_uncovered(rendering.image.float(), rendering.mask.float(), batch)
            found.append((shown.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
        return found

    parts = map_batches(render, model, images, batch_size=batch_size, progress=progress)
    return [np.concatenate(part) for part in zip(*parts, strict=True)]
