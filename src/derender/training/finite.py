"""Which value of a training step is the first that is no number, by the stage that made it.

A NaN need not reach the loss: a depth that is none covers no pixel, and a pixel that nothing covers does
not count. So every stage is looked at, and every gradient before it is used. Leaves out pictures: bytes.
"""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from derender.training.step import StepResult
from derender.training.watch import SLOWER, Finding


def first_not_finite(stages: Iterable[tuple[str, Tensor]]) -> str | None:
    """The name of the first tensor that holds NaN or infinity; None where none does."""
    named = [(name, value.detach()) for name, value in stages]
    if not named:
        return None
    sound = torch.stack([value.isfinite().all() for _, value in named]).tolist()
    return next((name for (name, _), one in zip(named, sound, strict=True) if not one), None)


def stages_of(result: StepResult) -> list[tuple[str, Tensor]]:
    """What every stage of a step gave, in the order in which they work."""
    found = [(f"the code of {name}", code) for name, code in result.codes.items()]
    found += [(f"the predicted {name}", value) for name, value in result.scene.parameters.items()]
    if result.confidence is not None:
        found += [(f"the {name} confidence", value) for name, value in vars(result.confidence).items()]
    found += [(f"the rendered {name}", value) for name, value in vars(result.rendering).items()]
    return found + [(f"the loss term {name!r}", value) for name, value in result.terms.items()]


def broken_gradient(model: nn.Module) -> str | None:
    """Names the first parameter whose gradient is not finite; None where all gradients are."""
    gradients = [(name, value.grad) for name, value in model.named_parameters() if value.grad is not None]
    if not gradients or bool(torch.stack([gradient.sum() for _, gradient in gradients]).isfinite().all()):
        return None  # a sum is finite only if its terms are
    return first_not_finite((f"the gradient of {name}", gradient) for name, gradient in gradients)


def not_finite(what: str, sign: str = "non-finite value") -> Finding:
    """The finding that ends a run."""
    return Finding(sign, f"{what} is not finite", f"{SLOWER}; with bf16, try 32-true", True)
