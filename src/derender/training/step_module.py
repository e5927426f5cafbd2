"""The step as a module, so that a strategy for several devices can average gradients in its backward pass."""

from jaxtyping import Float
from torch import Generator, Tensor, nn

from derender.model import Derenderer
from derender.objectives.perceptual import PerceptualFeatures
from derender.training.config import ObjectiveSettings
from derender.training.distributed import ALONE, Ranks
from derender.training.sharing import own_share
from derender.training.step import Precision, training_step
from derender.training.task import StepLosses


class Held:
    """Keeps a result out of sight of wrappers that walk through a module's output in search of tensors."""

    def __init__(self, result: StepLosses):
        self.result = result


class StepModule(nn.Module):
    """Model, objective and perceptual features; a batch goes in, the total and the result come out.

    Args:
        model: the model.
        objective: what is minimised.
        perceptual: features to compare, or None.
        ranks: those that share the batches of training; held-out pictures are each judged by one of them.
        chunks: see `training_step`.
    """

    def __init__(
        self,
        model: Derenderer,
        objective: ObjectiveSettings,
        perceptual: PerceptualFeatures | None,
        ranks: Ranks = ALONE,
        chunks: int = 1,
    ):
        super().__init__()
        self.model, self.objective, self.perceptual = model, objective, perceptual
        self.ranks, self.chunks = ranks, chunks

    def forward(
        self, images: Tensor, generator: Generator, precision: Precision, done: float | None = None
    ) -> tuple[Tensor, Held]:
        objective = self.objective
        if done is not None and done < objective.loocc_after:
            objective = objective.model_copy(update={"loocc": "none"})
        own = 1.0 if done is None else own_share(objective, done)
        ranks = ALONE if done is None else self.ranks
        result = training_step(
            self.model,
            images,
            objective,
            self.perceptual,
            generator,
            precision,
            own,
            ranks,
            self.chunks,
        )
        return result.total, Held(result)


def compute_step(
    module: nn.Module,
    images: Float[Tensor, "n 3 h w"],
    generator: Generator,
    precision: Precision,
    done: float | None = None,
) -> StepLosses:
    """The losses of one batch through a task's step module, wrapped by a strategy or not.

    ``done`` is the share of the run that lies behind, for what changes in its course; None where the model is
    judged as it will be used.
    """
    _, held = module(images, generator, precision, done)
    return held.result
