"""What the operators for bilinear look-up share, whatever they run on: shapes and derivative."""

from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]


def empty_colour(image: Tensor, mask: Tensor) -> Tensor:
    """Room for the image's value at each place of the mask."""
    return image.new_empty((*image.shape[:2], *mask.shape[1:]))


def empty_gradients(image: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Room for the gradient of both."""
    return image.new_empty(image.shape), uv.new_empty(uv.shape)


def connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and tell both's shapes to torch.compile."""

    def output(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
        return empty_colour(image, mask)

    def gradients(grad: Tensor, image: Tensor, uv: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        return empty_gradients(image, uv)

    def set_up(ctx, inputs, output) -> None:
        ctx.save_for_backward(*inputs)

    def differentiate(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        return *backward(grad, *ctx.saved_tensors), None

    forward.register_fake(output)
    backward.register_fake(gradients)
    forward.register_autograd(differentiate, setup_context=set_up)
