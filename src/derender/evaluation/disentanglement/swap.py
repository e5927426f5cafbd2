"""The swap test: exchange one factor between two images, render, encode again, and see which features moved.

A check that correlations cannot give, since an untrained encoder has low ones too. For every image i and its
donor p(i), a random derangement:

    plain(i)      = E(render(scene_i)), the features of the image's own rendering
    swapped_k(i)  = E(render(scene_i with parameter k of scene_p(i)))
    moved[k, j]   = mean_i |swapped_k(i)_j - plain(i)_j|  /  mean_i |plain(i)_j - plain(p(i))_j|

so 0 means that feature j stayed and 1 that it moved as far as two different images are apart. Best: the
identity matrix. Both ends of a difference are renderings, so the loss of reconstruction does not count; it is
reported by itself as ``unexchanged``. |.| is the Euclidean distance. The same is done with the decoded
parameters (angles in radians beside intensities and scene units, as the scene holds them) and with the
pixels. Pixels that no surface covers are filled with the mean colour of the input image's edge, by the rule
of training (training/step.py). Leaves out whether a swapped image looks right.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from derender.data import as_float
from derender.evaluation.bootstrap import RESAMPLES, resamples
from derender.features import Progress
from derender.scene import Scene
from derender.scene.perturb import derangement
from derender.training.step import fill_uncovered

Distances = Mapping[str, np.ndarray]
"""By "feature NAME", "parameter NAME" and "pixels", (N,) Euclidean distances."""


@dataclass(frozen=True)
class SwapScores:
    """How far features moved, in units of the mean distance between an image and its donor; NaN where that
    is 0 (a feature or parameter that is the same for every image).

    Attributes:
        factors: names, in the order of rows and columns.
        moved: (F, F) features; row: the factor exchanged, column: the feature that moved. Best 1 on the
            diagonal, 0 elsewhere.
        moved_parameters: (F, F) the same of decoded depth, albedo, light and camera.
        moved_pixels: (F,) how far the image itself moved when this factor was exchanged.
        arrived: (F,) remaining distance from the exchanged feature to the donor's, best 0.
        unexchanged: (F,) how far features move from an image to its own rendering, best 0.
        ratio, ratio_parameters: mean of the diagonal over mean of the rest; 1 where nothing is disentangled,
            more is better.
        n_pictures: how many images each number is a mean of.
        resampled: (B, 2) ``ratio`` and ``ratio_parameters`` on resamples of the images, for intervals.
    """

    factors: tuple[str, ...]
    moved: np.ndarray
    moved_parameters: np.ndarray
    moved_pixels: np.ndarray
    arrived: np.ndarray
    unexchanged: np.ndarray
    ratio: float
    ratio_parameters: float
    n_pictures: int
    resampled: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)), repr=False)


def swap_test(
    model: Any,
    images: np.ndarray,
    *,
    seed: int = 0,
    batch_size: int = 64,
    progress: Progress | None = None,
) -> SwapScores:
    """The swap test on uint8 images (N, 3, H, W), N of 2 or more.

    Args:
        model: a ``Derenderer``; stays as it was.
        images: at the model's image size.
        seed: of the donors.
        batch_size: images at a time; changes speed and memory only.
        progress: called with (renderings done, renderings in all).
    """
    if len(images) < 2:
        raise ValueError(f"the swap test needs two images or more, got {len(images)}")
    parameters = {factor.name: factor.parameter for factor in model.factors}
    donor = derangement(len(images), torch.Generator().manual_seed(seed))
    total, done = len(images) * (len(parameters) + 1), 0

    def report(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, total)

    was_training = model.training
    model.eval()
    try:
        with torch.inference_mode():
            scenes, inputs = _decompose(model, images, batch_size)
            plain = _encode_renderings(model, scenes, images, parameters, batch_size, report)
            apart = _distances(plain, {key: value[donor] for key, value in plain.items()})
            moves: list[Distances] = []
            left = []
            for name, parameter in parameters.items():
                exchanged = scenes.with_parameters(**{parameter: scenes.parameters[parameter][donor]})
                again = _encode_renderings(model, exchanged, images, parameters, batch_size, report)
                moves.append(_distances(again, plain))
                own = f"feature {name}"
                left.append(_distances({own: again[own]}, {own: plain[own][donor]}))
            loss = _distances({key: plain[key] for key in inputs}, inputs)
    finally:
        model.train(was_training)
    unit = {key: float(each.mean()) or math.nan for key, each in apart.items()}

    def matrix(keys: Sequence[str]) -> np.ndarray:
        return np.array([[float(row[key].mean()) / unit[key] for key in keys] for row in moves])

    def resampled(keys: Sequence[str]) -> np.ndarray:
        return _resampled(np.array([[row[key] for row in moves] for key in keys]), [apart[k] for k in keys])

    features, decoded = ([f"{kind} {name}" for name in parameters] for kind in ("feature", "parameter"))
    moved, moved_parameters = matrix(features), matrix(decoded)
    return SwapScores(
        factors=tuple(parameters),
        moved=moved,
        moved_parameters=moved_parameters,
        moved_pixels=matrix(["pixels"])[:, 0],
        arrived=np.array([float(row[key].mean()) / unit[key] for row in left for key in row]),
        unexchanged=np.array([float(loss[key].mean()) / unit[key] for key in features]),
        ratio=diagonal_over_rest(moved),
        ratio_parameters=diagonal_over_rest(moved_parameters),
        n_pictures=len(images),
        resampled=np.stack([resampled(features), resampled(decoded)], axis=1),
    )


def diagonal_over_rest(moved: np.ndarray) -> float:
    """Mean of the diagonal over mean of the other cells of a square matrix; infinite where these are 0, NaN
    where a cell is NaN.
    """
    own = np.eye(len(moved), dtype=bool)
    rest = moved[~own].mean()
    if rest == 0:
        return float("inf") if moved[own].mean() > 0 else float("nan")
    return float(moved[own].mean() / rest)


def _resampled(moves: np.ndarray, apart: Sequence[np.ndarray]) -> np.ndarray:
    """(B,) mean of the diagonal over mean of the rest on resamples of the images.

    Args:
        moves: (columns, rows, N) how far each image's feature moved.
        apart: for every column, (N,) how far each image is from its donor.
    """
    weights = np.concatenate(list(resamples(len(apart[0]), RESAMPLES))).astype(np.float64)
    between = np.stack([weights @ each for each in apart])  # (columns, B)
    moved = np.stack([[weights @ each for each in column] for column in moves])  # (columns, rows, B)
    own = np.eye(len(apart), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = moved / between[:, None]
        return share[own].mean(axis=0) / share[~own].mean(axis=0)


def _decompose(model: Any, images: np.ndarray, batch_size: int) -> tuple[Scene, dict[str, Tensor]]:
    """Scenes of images and the features they were decoded from (as "feature NAME"), on the CPU."""
    scenes, features = [], []
    for start in range(0, len(images), batch_size):
        activations = model.activations(as_float(images[start : start + batch_size]).to(model.device))
        scenes.append(model.decode(model.codes(activations)).to("cpu").parameters)
        found = model.features_from(activations)
        features.append({f"feature {name}": value.float().cpu() for name, value in found.items()})
    return Scene.from_parameters(_joined(scenes)), _joined(features)


def _encode_renderings(
    model: Any,
    scenes: Scene,
    images: np.ndarray,
    parameters: Mapping[str, str],
    batch_size: int,
    report: Callable[[int], object],
) -> dict[str, Tensor]:
    """Features, decoded parameters and pixels of the renderings of scenes, by the keys of ``Distances``."""
    parts: list[dict[str, Tensor]] = []
    for start in range(0, len(scenes), batch_size):
        rows = slice(start, start + batch_size)
        rendering = model.render(scenes[rows].to(model.device))
        inputs = as_float(images[rows]).to(model.device)
        rendered = fill_uncovered(rendering.image.float(), rendering.mask.float(), inputs)
        activations = model.activations(rendered)
        decoded, features = (
            model.decode(model.codes(activations)).parameters,
            model.features_from(activations),
        )
        part = {f"feature {name}": features[name] for name in parameters}
        part |= {f"parameter {name}": decoded[parameter] for name, parameter in parameters.items()}
        parts.append({key: value.float().cpu() for key, value in (part | {"pixels": rendered}).items()})
        report(len(rendered))
    return _joined(parts)


def _joined(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def _distances(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {key: (a[key].double() - b[key].double()).flatten(1).norm(dim=1).numpy(force=True) for key in a}
