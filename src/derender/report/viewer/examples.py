"""Pictures to begin with: those that were named, or generated ones for the models that come with derender."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

GENERATED = 8
SEED = 3


@dataclass(frozen=True)
class Example:
    """A picture to choose.

    Attributes:
        name: what the page calls it.
        picture: its pixels at the model's size.
    """

    name: str
    picture: UInt8[np.ndarray, "3 s s"]


def named_examples(pictures: Mapping[Path, np.ndarray]) -> list[Example]:
    """Pictures that were named, by file name."""
    return [Example(path.name, picture) for path, picture in pictures.items()]


def generated_examples(
    model: str, image_size: int, count: int = GENERATED, progress: Callable[[int, int], object] | None = None
) -> list[Example]:
    """Rendered pictures of the kind that a bundled model knows; none for other models."""
    from derender.data.synthetic import FaceSettings, SyntheticSet, cars, faces
    from derender.model import bundled_models

    if model not in bundled_models():
        return []
    generators: dict[str, Callable[..., SyntheticSet]] = {
        "face": partial(faces.generate, settings=FaceSettings(pictures_per_identity=1)),
        "car": cars.generate,
    }
    kind = next((kind for kind in generators if kind in model), None)
    if kind is None:
        return []
    made = generators[kind](count, image_size, seed=SEED, progress=progress)
    return [Example(f"rendered {kind} {number}", picture) for number, picture in enumerate(made.images, 1)]
