"""Built-in images with exact ground truth: procedural generators that need no download.

``faces.generate`` and ``cars.generate`` make them, ``write`` saves them in the layout of the rendered data
sets. ``write_benchmark`` writes the fixed sets of published scores.
"""

from derender.data.synthetic import cars, faces
from derender.data.synthetic.benchmark import KINDS, write_benchmark, write_generated
from derender.data.synthetic.morphable import MorphableFaces
from derender.data.synthetic.settings import (
    CAR_LIGHTS,
    CAR_VIEWS,
    LIGHTS,
    VIEWS,
    CarSettings,
    CarViewSettings,
    FaceSettings,
    LightSettings,
    ViewSettings,
    named_settings,
)
from derender.data.synthetic.synthetic_set import SyntheticSet, require_empty, write

__all__ = [
    "CAR_LIGHTS", "CAR_VIEWS", "KINDS", "LIGHTS", "VIEWS", "CarSettings", "CarViewSettings", "FaceSettings",
    "LightSettings", "MorphableFaces", "SyntheticSet", "ViewSettings", "cars", "faces", "named_settings",
    "require_empty", "write", "write_benchmark", "write_generated",
]  # fmt: skip
