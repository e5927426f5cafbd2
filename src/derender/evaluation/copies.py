"""How near a copy of a model comes to the model: its features and its renderings of the same images.

Rounding weights moves every feature a little; the unit is how far two of these images are apart.
"""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from derender.evaluation.pixels import evaluate_reconstruction
from derender.features import Progress, embed_images

if TYPE_CHECKING:
    from derender.model import Derenderer


@dataclass(frozen=True)
class CopyCost:
    """What changed: by factor, how far an image's feature moved (mean over images, over the root mean square
    distance of two images' features; 0: not at all), and the mean absolute error of the images re-rendered,
    0..1, inside each one's mask, by the copy and by the model.
    """

    moved: dict[str, float]
    l1: float
    l1_before: float


def copy_cost(
    model: "Derenderer", copy: "Derenderer", images: np.ndarray, *, progress: Progress | None = None
) -> CopyCost:
    """Compare a copy of a model with it on uint8 images (N, 3, H, W).

    ``progress`` is called with (features made, features to make), two of each image.

    Raises:
        ValueError: fewer than two images, or other factors.
    """
    if len(images) < 2:
        raise ValueError(f"two images or more are needed to compare models, got {len(images)}")
    names = [[factor.name for factor in one.factors] for one in (model, copy)]
    if names[0] != names[1]:
        raise ValueError(f"the models have other factors: {', '.join(names[0])}; {', '.join(names[1])}")
    passes = []
    for number, one in enumerate((model, copy)):
        report = progress and partial(lambda start, done, of: progress(start * of + done, 2 * of), number)
        passes.append(embed_images(one, images, progress=report))
    moved = {}
    for name in names[0]:
        own, other = (np.asarray(one[name], np.float64) for one in passes)
        apart = np.sqrt(2 * own.var(axis=0, ddof=1).sum())  # of two images drawn at random
        moved[name] = float(np.linalg.norm(own - other, axis=1).mean() / apart) if apart else 0.0
    errors = [evaluate_reconstruction(one, images).model.l1 for one in (copy, model)]
    return CopyCost(moved, *errors)
