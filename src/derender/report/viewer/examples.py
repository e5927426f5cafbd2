"""Pictures to begin with: those that were named, or rendered ones for the models that come with derender.

Faces lie beside this file in faces.png, one row: eight of the 800 pictures that ``rendered-faces-64`` was
tested on, evenly spaced (geometry ICT-FaceKit, MIT; skins MakeHuman, CC0). They show nobody, and no model saw
them in training. Heads of ``derender synth`` have hair, which that model does not know.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

FACES = "faces.png"


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


def rendered_examples(model: str, image_size: int) -> list[Example]:
    """Rendered faces for a bundled model of faces; none for other models."""
    from derender.model import bundled_models

    if model not in bundled_models() or "face" not in model:
        return []
    content = files("derender.report.viewer").joinpath(FACES).read_bytes()
    with Image.open(BytesIO(content)) as row:
        row.load()
    examples = []
    for number in range(row.width // row.height):
        tile = row.crop((number * row.height, 0, (number + 1) * row.height, row.height))
        pixels = np.asarray(tile.convert("RGB").resize((image_size, image_size), Image.Resampling.LANCZOS))
        examples.append(Example(f"rendered face {number + 1}", np.moveaxis(pixels, -1, 0).copy()))
    return examples
