"""The step as a module, so that a strategy for several devices can average gradients in its backward pass."""

from jaxtyping import Float
from torch import Generator, Tensor, nn

from derender.model import Derenderer
from derender.objectives.perceptual import PerceptualFeatures
from derender.training.config import ObjectiveSettings
from derender.training.step import Precision, StepResult, training_step


class Held:
    """Keeps a result out of sight of wrappers that walk through a module's output in search of tensors."""

    def __init__(self, result: StepResult):
        self.result = result


class StepModule(nn.Module):
    """Model, objective and perceptual features; a batch goes in, the total and the result come out."""

    def __init__(
        self, model: Derenderer, objective: ObjectiveSettings, perceptual: PerceptualFeatures | None
    ):
        super().__init__()
        self.model, self.objective, self.perceptual = model, objective, perceptual

    def forward(self, images: Tensor, generator: Generator, precision: Precision) -> tuple[Tensor, Held]:
        result = training_step(self.model, images, self.objective, self.perceptual, generator, precision)
        return result.total, Held(result)


def compute_step(
    module: nn.Module, images: Float[Tensor, "n 3 h w"], generator: Generator, precision: Precision
) -> StepResult:
    """The losses of one batch through a `StepModule`, wrapped by a strategy or not."""
    _, held = module(images, generator, precision)
    return held.result
