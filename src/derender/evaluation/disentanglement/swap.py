"""The swap test: exchange one factor between two pictures, render, encode again, see which features moved.

Ours; it is the check that correlations cannot give, since an untrained encoder has low ones too. For every
picture i and its donor p(i), drawn so that nobody is his own donor:

    plain(i)      = E(render(scene_i)), the features of the picture's own rendering
    swapped_k(i)  = E(render(scene_i with parameter k of scene_p(i)))
    moved[k, j]   = mean_i |swapped_k(i)_j - plain(i)_j|  /  mean_i |plain(i)_j - plain(p(i))_j|

so 0 means that feature j stayed and 1 that it moved as far as two different pictures are apart. Best: the
identity matrix. Both ends of a difference are renderings, so what reconstruction loses does not count; it is
reported by itself as ``unexchanged``. |.| is the Euclidean distance. The same is done with the decoded
parameters (angles in radians beside intensities and scene units, as the scene holds them) and with the
pixels. Pixels that no surface covers are filled with the mean colour of the input picture's edge, by the rule
of training (training/step.py). Leaves out whether a swapped picture looks right.
"""

import math
from collections.abc import Callable, Mapping
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


@dataclass(frozen=True)
class SwapScores:
    """What moved; everything in units of the mean distance between a picture and its donor, and NaN where
    that is 0 (a feature or parameter that is the same for every picture).

    Attributes:
        factors: names, in the order of rows and columns.
        moved: (F, F) features; row: the factor exchanged, column: the feature that moved. Best 1 on the
            diagonal, 0 elsewhere.
        moved_parameters: (F, F) the same of decoded depth, albedo, light and camera.
        moved_pixels: (F,) how far the picture itself moved when this factor was exchanged.
        arrived: (F,) distance that is left from the exchanged feature to the donor's, best 0.
        unexchanged: (F,) how far features move from a picture to its own rendering, best 0.
        ratio, ratio_parameters: mean of the diagonal over mean of the rest; 1 where nothing is disentangled,
            more is better.
        n_pictures: how many pictures each number is a mean of.
        resampled: (B, 2) ``ratio`` and ``ratio_parameters`` on resamples of the pictures, for intervals.
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
    """The swap test on uint8 pictures (N, 3, H, W), N of 2 or more.

    Args:
        model: with ``factors``, ``embed``, ``decode``, ``render``, ``device``.
        images: pictures at the model's image size.
        seed: of who is whose donor.
        batch_size: pictures at a time; changes speed and memory only.
        progress: called with (renderings done, renderings in all).
    """
    if len(images) < 2:
        raise ValueError(f"the swap test needs two pictures or more, got {len(images)}")
    names = tuple(factor.name for factor in model.factors)
    parameters = {factor.name: factor.parameter for factor in model.factors}
    donor = derangement(len(images), torch.Generator().manual_seed(seed))
    total, done = len(images) * (len(names) + 1), 0

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
            plain = _seen_again(model, scenes, images, parameters, batch_size, report)
            moved, moved_parameters = np.zeros((2, len(names), len(names)))
            moved_pixels, arrived = np.zeros((2, len(names)))
            apart_each = {key: _distances(value, value[donor]) for key, value in plain.items()}
            apart = {key: float(each.mean()) or math.nan for key, each in apart_each.items()}
            moves: dict[str, list[np.ndarray]] = {key: [] for key in plain}
            for row, name in enumerate(names):
                value = scenes.parameters[parameters[name]]
                exchanged = scenes.with_parameters(**{parameters[name]: value[donor]})
                seen = _seen_again(model, exchanged, images, parameters, batch_size, report)
                for key in plain:
                    moves[key].append(_distances(seen[key], plain[key]))
                far = {key: float(moves[key][-1].mean()) / apart[key] for key in plain}
                moved[row] = [far[f"feature {other}"] for other in names]
                moved_parameters[row] = [far[f"parameter {other}"] for other in names]
                moved_pixels[row] = far["pixels"]
                key = f"feature {name}"
                arrived[row] = _distance(seen[key], plain[key][donor]) / apart[key]
            keys = {name: f"feature {name}" for name in names}
            unexchanged = [_distance(plain[key], inputs[name]) / apart[key] for name, key in keys.items()]
    finally:
        model.train(was_training)
    return SwapScores(
        names,
        moved,
        moved_parameters,
        moved_pixels,
        arrived,
        np.array(unexchanged),
        diagonal_over_rest(moved),
        diagonal_over_rest(moved_parameters),
        len(images),
        np.stack(
            [
                _resampled(
                    [moves[f"{kind} {name}"] for name in names], [apart_each[f"{kind} {n}"] for n in names]
                )
                for kind in ("feature", "parameter")
            ],
            axis=1,
        ),
    )


def _resampled(moves: list[list[np.ndarray]], apart: list[np.ndarray]) -> np.ndarray:
    """(B,) mean of the diagonal over mean of the rest on resamples of the pictures.

    Args:
        moves: for every column, for every row, (N,) how far each picture's feature moved.
        apart: for every column, (N,) how far each picture is from its donor.
    """
    weights = np.concatenate(list(resamples(len(apart[0]), RESAMPLES))).astype(np.float64)
    between = np.stack([weights @ each for each in apart])  # (columns, B)
    moved = np.stack([[weights @ each for each in column] for column in moves])  # (columns, rows, B)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = moved / between[:, None]
        own = np.eye(len(apart), dtype=bool)
        return share[own].mean(axis=0) / share[~own].mean(axis=0)


def diagonal_over_rest(moved: np.ndarray) -> float:
    """Mean of the diagonal over mean of the other cells of a square matrix; infinite where these are 0, NaN
    where a cell is not known.
    """
    own = np.eye(len(moved), dtype=bool)
    rest = moved[~own].mean()
    if rest == 0:
        return float("inf") if moved[own].mean() > 0 else float("nan")
    return float(moved[own].mean() / rest)


def _decompose(model: Any, images: np.ndarray, batch_size: int) -> tuple[Scene, dict[str, Tensor]]:
    """Scenes of pictures and the features they were decoded from, on the CPU."""
    scenes, codes = [], []
    for start in range(0, len(images), batch_size):
        activations = model.activations(as_float(images[start : start + batch_size]).to(model.device))
        scenes.append(model.decode(model.codes(activations)).to("cpu"))
        codes.append({name: value.float().cpu() for name, value in model.features_from(activations).items()})
    joined = {name: torch.cat([scene.parameters[name] for scene in scenes]) for name in scenes[0].parameters}
    return Scene.from_parameters(joined), {name: torch.cat([c[name] for c in codes]) for name in codes[0]}


def _seen_again(
    model: Any,
    scenes: Scene,
    images: np.ndarray,
    parameters: Mapping[str, str],
    batch_size: int,
    report: Callable[[int], object],
) -> dict[str, Tensor]:
    """Features, decoded parameters and pixels of the renderings of scenes, by "feature NAME" and so on."""
    parts: list[dict[str, Tensor]] = []
    for start in range(0, len(scenes), batch_size):
        rows = slice(start, start + batch_size)
        rendering = model.render(scenes[rows].to(model.device))
        pictures = as_float(images[rows]).to(model.device)
        shown = fill_uncovered(rendering.image.float(), rendering.mask.float(), pictures)
        activations = model.activations(shown)
        decoded, features = (
            model.decode(model.codes(activations)).parameters,
            model.features_from(activations),
        )
        part = {f"feature {name}": features[name] for name in parameters}
        part |= {f"parameter {name}": decoded[parameter] for name, parameter in parameters.items()}
        parts.append({key: value.float().cpu() for key, value in (part | {"pixels": shown}).items()})
        report(len(shown))
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def _distances(a: Tensor, b: Tensor) -> np.ndarray:
    """(N,) Euclidean distances of rows."""
    return (a.double() - b.double()).flatten(1).norm(dim=1).numpy(force=True)


def _distance(a: Tensor, b: Tensor) -> float:
    """Mean over rows of the Euclidean distance."""
    return float(_distances(a, b).mean())
