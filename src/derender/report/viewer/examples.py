"""Pictures to begin with: those that were named, or rendered ones for the models that come with derender.

Faces lie beside this file in faces.png, one row: eight of the 800 pictures that ``rendered-faces-64`` was
tested on, evenly spaced (geometry ICT-FaceKit, MIT; skins MakeHuman, CC0). They show nobody, and no model saw
them in training. Heads of ``derender synth`` have hair, which that model does not know. Cars lie in cars.png:
eight of the 1,000 that ``cars-64`` was tested on, evenly by class (Kenney and Quaternius, CC0).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

ROWS = {"faces-64": "faces.png", "rendered-faces-64": "faces.png", "cars-64": "cars.png"}


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
    """Rendered faces or cars for the models that come with derender; none for other models."""
    if model not in ROWS:
        return []
    content = files("derender.report.viewer").joinpath(ROWS[model]).read_bytes()
    with Image.open(BytesIO(content)) as row:
        row.load()
    examples = []
    for number in range(row.width // row.height):
        tile = row.crop((number * row.height, 0, (number + 1) * row.height, row.height))
        pixels = np.asarray(tile.convert("RGB").resize((image_size, image_size), Image.Resampling.LANCZOS))
        name = f"rendered {ROWS[model].removesuffix('s.png')} {number + 1}"
        examples.append(Example(name, np.moveaxis(pixels, -1, 0).copy()))
    return examples
