"""What the rasteriser's operators share, whatever they run on: shapes and derivative."""

import torch
from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]


def empty_outputs(vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Room for uv, depth and the visible triangle of (N, H, W, 3) vertices."""
    size = vertices.shape[:3]
    return (
        vertices.new_empty((*size, 2)),
        vertices.new_empty(size),
        vertices.new_empty(size, dtype=torch.int32),
    )


def connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and tell both's shapes to torch.compile."""

    def outputs(vertices: Tensor, focal_px: float) -> tuple[Tensor, Tensor, Tensor]:
        return empty_outputs(vertices)

    def gradient(
        grad_uv: Tensor, grad_depth: Tensor, vertices: Tensor, triangle: Tensor, focal_px: float
    ) -> Tensor:
        return vertices.new_empty(vertices.shape)

    def set_up(ctx, inputs, output) -> None:
        ctx.focal_px = inputs[1]
        ctx.mark_non_differentiable(output[2])
        ctx.save_for_backward(inputs[0], output[2])

    def differentiate(ctx, grad_uv: Tensor, grad_depth: Tensor, _) -> tuple[Tensor, None]:
        vertices, triangle = ctx.saved_tensors
        return backward(grad_uv, grad_depth, vertices, triangle, ctx.focal_px), None

    forward.register_fake(outputs)
    backward.register_fake(gradient)
    forward.register_autograd(differentiate, setup_context=set_up)
