"""What the shading operators share, whatever they run on: shapes and derivative."""

from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]


def empty_gradients(depth: Tensor, albedo: Tensor, lamp: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Room for the gradient of each."""
    return depth.new_empty(depth.shape), albedo.new_empty(albedo.shape), lamp.new_empty(lamp.shape)


def connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and tell both's shapes to torch.compile."""

    def output(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
        return albedo.new_empty(albedo.shape)

    def gradients(
        grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        return empty_gradients(depth, albedo, lamp)

    def set_up(ctx, inputs, output) -> None:
        *values, ctx.focal_px = inputs
        ctx.save_for_backward(*values)

    def differentiate(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        return *backward(grad, *ctx.saved_tensors, ctx.focal_px), None

    forward.register_fake(output)
    backward.register_fake(gradients)
    forward.register_autograd(differentiate, setup_context=set_up)
