"""The swap test: exchange one factor between two images, render, encode again, and see which features moved.

A check that correlations cannot give, since an untrained encoder has low ones too. For every image i and its
donor p(i), a random derangement:

    plain(i)      = E(render(scene_i)), the features of the image's own rendering
    swapped_k(i)  = E(render(scene_i with parameter k of scene_p(i)))
    moved[k, j]   = mean_i |swapped_k(i)_j - plain(i)_j|  /  mean_i |plain(i)_j - plain(p(i))_j|

so 0 means that feature j stayed and 1 that it moved as far as two different images are apart. Best: the
identity matrix. Both ends of a difference are renderings; the loss of reconstruction is reported by itself as
``unexchanged``. The same is done with the decoded parameters and with the pixels. Pixels that no surface
covers are filled as in training (training/step.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.linalg import vector_norm

from derender.data import as_float
from derender.evaluation.bootstrap import RESAMPLES, resamples
from derender.scene import Scene
from derender.scene.perturb import derangement
from derender.training.process import evaluating
from derender.training.step import fill_uncovered


@dataclass(frozen=True)
class SwapScores:
    """How far F features moved, in units of the mean distance of an image and its donor; NaN where that is 0.

    ``moved`` and ``moved_parameters`` (decoded) are (F, F): row, the factor exchanged, column, what moved;
    best the identity. ``arrived`` is the remaining distance to the donor's feature, ``unexchanged`` the move
    from an image to its own rendering, both best 0. Each ``ratio`` is the mean of the diagonal over that of
    the rest, 1 where nothing is disentangled. ``resampled`` (B, 2) has both on resamples of the images.
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


Encodings = dict[str, Tensor]  # of N images, by "feature NAME", "parameter NAME" (decoded) and "pixels"


def encodings(
    model: Any, images: np.ndarray, scenes: Scene | None = None, *, batch_size: int = 64
) -> Encodings:
    """Of (N, 3, H, W) uint8 images, or of the renderings of scenes, filled from the images."""
    parts = []
    with evaluating(model), torch.inference_mode():
        for start in range(0, len(images), batch_size):
            rows = slice(start, start + batch_size)
            pixels = as_float(images[rows]).to(model.device)
            if scenes is not None:
                result = model.render(scenes[rows].to(model.device))
                pixels = fill_uncovered(result.image.float(), result.mask.float(), pixels)
            start = model.decode(model.encode(pixels)) if model.features.fits_scenes else None
            activations = model.activations(pixels, scenes=start)
            features = model.features_from(activations)
            decoded = start or model.decode(model.codes(activations))
            part = {f"parameter {name}": each for name, each in decoded.parameters.items()}
            part |= {"pixels": pixels, **{f"feature {f.name}": features[f.name] for f in model.factors}}
            parts.append({key: each.float().cpu() for key, each in part.items()})
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def swap_test(
    model: Any, images: np.ndarray, *, seed: int = 0, batch_size: int = 64,
    known: Mapping[str, np.ndarray] | None = None,
) -> SwapScores:  # fmt: skip
    """The swap test of a ``Derenderer`` on (N, 3, H, W) uint8 images, two or more; ``seed`` draws donors.

    ``known`` are the images' features by name, each (N, D); by default they are computed.
    """
    if len(images) < 2:
        raise ValueError(f"the swap test needs two images or more, got {len(images)}")
    features = [f"feature {factor.name}" for factor in model.factors]
    parameters = [factor.parameter for factor in model.factors]
    donor = derangement(len(images), torch.Generator().manual_seed(seed))
    inputs = encodings(model if known is None else model.without_features(), images, batch_size=batch_size)
    inputs |= {f"feature {name}": torch.from_numpy(rows) for name, rows in (known or {}).items()}
    stored = (key for key in inputs if key.startswith("parameter "))
    scene = Scene.from_parameters({key.removeprefix("parameter "): inputs[key] for key in stored})
    plain = encodings(model, images, scene, batch_size=batch_size)
    exchanged = [scene.with_parameters(**{name: scene.parameters[name][donor]}) for name in parameters]
    swapped = [encodings(model, images, one, batch_size=batch_size) for one in exchanged]
    donors = {key: each[donor] for key, each in plain.items()}
    apart = _distances(plain, donors)
    unit = {key: each.mean() or np.nan for key, each in apart.items()}
    moves = [_distances(each, plain) for each in swapped]
    left = [_distances({key: each[key] for key in features}, donors) for each in swapped]
    weights = np.concatenate(list(resamples(len(images), RESAMPLES))).astype(np.float64)

    def matrix(keys: Sequence[str]) -> tuple[np.ndarray, Any]:
        """(F, F) mean moves, and the ratio of its diagonal on resamples."""
        each = np.array([[row[key] for key in keys] for row in moves])
        between = np.stack([apart[key] for key in keys])
        with np.errstate(divide="ignore", invalid="ignore"):
            drawn = diagonal_over_rest((each @ weights.T) / (between @ weights.T))
        return each.mean(axis=2) / np.array([unit[key] for key in keys]), drawn

    (moved, drawn), loss = matrix(features), _distances(plain, inputs)
    decoded, drawn_decoded = matrix([f"parameter {name}" for name in parameters])
    return SwapScores(
        tuple(factor.name for factor in model.factors),
        moved,
        decoded,
        np.array([row["pixels"].mean() / unit["pixels"] for row in moves]),
        np.array([row[key].mean() / unit[key] for row, key in zip(left, features, strict=True)]),
        np.array([loss[key].mean() / unit[key] for key in features]),
        float(diagonal_over_rest(moved)),
        float(diagonal_over_rest(decoded)),
        len(images),
        np.stack([drawn, drawn_decoded], axis=1),
    )


def diagonal_over_rest(moved: np.ndarray) -> np.ndarray | np.floating:
    """Mean of the diagonal over that of the other cells of (F, F, ...) matrices. Infinite where these are 0,
    NaN where all or any are NaN."""
    own = np.eye(len(moved), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(moved[own].mean(axis=0), moved[~own].mean(axis=0))


def _distances(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    apart = {key: (a[key] - b[key]).flatten(1) for key in a}
    return {key: vector_norm(each, dim=1, dtype=torch.float64).numpy() for key, each in apart.items()}
