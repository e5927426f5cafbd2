"""What the warping operators share, whatever they run on: shapes and derivative."""

import torch
from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]


def empty_outputs(image: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Room for the picture, depth, mask and visible triangle."""
    return (
        image.new_empty(image.shape),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape, dtype=torch.int32),
    )


def empty_gradients(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Room for the gradient of each."""
    image, depth, rotation, offset = (
        value.new_empty(value.shape) for value in (image, depth, rotation, offset)
    )
    return image, depth, rotation, offset


def connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and tell both's shapes to torch.compile."""

    def outputs(
        image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return empty_outputs(image, depth)

    def gradients(
        grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
        offset: Tensor, triangle: Tensor, focal: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        return empty_gradients(image, depth, rotation, offset)

    def set_up(ctx, inputs, output) -> None:
        *values, ctx.focal = inputs
        ctx.mark_non_differentiable(output[2], output[3])
        ctx.save_for_backward(*values, output[3])

    def differentiate(ctx, grad_colour: Tensor, grad_depth: Tensor, *_) -> tuple[Tensor | None, ...]:
        return *backward(grad_colour, grad_depth, *ctx.saved_tensors, ctx.focal), None

    forward.register_fake(outputs)
    backward.register_fake(gradients)
    forward.register_autograd(differentiate, setup_context=set_up)
