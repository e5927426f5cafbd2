"""Sample sheet of a baseline's training: some pictures and what the network makes of them."""

from collections.abc import Callable, Mapping
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.report import colours
from derender.report.panel import labelled_grid

Shown = Callable[[Any, Tensor], Mapping[str, Tensor]]


def baseline_sheet(shown: Shown) -> Callable[[Any, Float[Tensor, "n 3 h w"]], Image.Image]:
    """A function of model and pictures (0..1) that draws a row for each picture, a column for each kind."""

    def sheet(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
        columns = shown(model, pictures)
        return labelled_grid({name: colours.pictures(values) for name, values in columns.items()})

    return sheet
