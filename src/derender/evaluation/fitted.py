"""A model as scores see it whose scenes are fitted to the pictures they are scored on."""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from derender.model import Derenderer
from derender.render import Rendering
from derender.scene import Scene


class FittedModel:
    """Everything is the model's, but scenes are fitted from what it says on.

    Args:
        model: with what fitting needs.
        steps: of every picture.
    """

    def __init__(self, model: Derenderer, steps: int):
        self.model = model
        self.steps = steps

    def decompose(self, images: Float[Tensor, "n 3 h w"]) -> Scene:
        """Fitted scenes of pictures in 0..1."""
        return self.model.fit_scenes(images, self.steps).scene

    def reconstruct(self, images: Float[Tensor, "n 3 h w"]) -> Rendering:
        """Pictures of the fitted scenes."""
        return self.model.render(self.decompose(images))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)
