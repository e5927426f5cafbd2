"""Show a canonical image, painted on the surface of a depth map, to a camera.

The surface's grid mesh is moved, rasterised (``rasterize``), and its colours looked up (``sample``).
`reference` composes the definitions of those, on any device, with where the surface lands in float64. Numba
and Triton do it all in one pass over the image, as torch operators with an analytic derivative, storing
neither the moved points nor the canonical coordinates. They give the same image, but for rounding, and the
same gradients.

Fast kernels are imported, and compiled, on the first call. Forward is the same bit for bit in every run;
backward too on any number of CPU threads, and on a GPU with torch's deterministic algorithms. ``grid_sample``
is not used: normalising coordinates to -1..1 and back costs the identity camera its exactness.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]

from derender.render.backends import chosen_backend
from derender.render.rasterize import mark_triangles, rasterize
from derender.render.triton_launch import (
    PIXELS_PER_PROGRAM,
    float64_bits,
    launch,
    programs_per_image,
    scattered_sums,
)
from derender.scene.camera import focal_px, motion, unproject


def warp(
    image: Float[Tensor, "n c h w"],
    depth: Float[Tensor, "n h w"],
    camera: Float[Tensor, "n 6"],
    fov_deg: float,
    backend: str = "auto",
) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
    """Image, depth and mask as the camera sees them; 0 where nothing is seen."""
    rotation, offset = motion(camera.double())
    chosen = chosen_backend(depth.device, backend)
    if chosen == "reference":
        return reference(image, depth, rotation, offset, fov_deg)
    return FORWARD[chosen](image, depth, rotation, offset, focal_px(depth.shape[2], fov_deg))[:3]


def reference(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, fov_deg: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Image (N, C, H, W), depth and mask (N, H, W) of a surface moved by rotation and offset (float64)."""
    points = unproject(depth.double(), fov_deg)
    moved = torch.baddbmm(offset[:, None], points.flatten(1, 2), rotation.transpose(1, 2))
    seen = rasterize(moved.view(points.shape), focal_px(depth.shape[2], fov_deg), "reference")
    uv, mask = seen.uv.to(image.dtype), seen.mask.to(image.dtype)
    return sample(image, uv, mask), seen.depth.to(image.dtype), mask


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """The image (N, C, H, W) at pixel coordinates (N, H2, W2, 2), bilinear; 0, no gradient where mask is 0.

    Beyond the border, which `rasterize` may exceed by its edge tolerance, the border cell is continued.
    """
    count, channels, height, width = image.shape
    uv = torch.where(mask[..., None] > 0, uv, 0)
    left = uv[..., 0].detach().floor().clamp(0, width - 2)
    top = uv[..., 1].detach().floor().clamp(0, height - 2)
    across, down = (uv[..., 0] - left)[:, None], (uv[..., 1] - top)[:, None]
    corner = (top * width + left).long().flatten(1)[:, None].expand(-1, channels, -1)

    def look_up(step: int) -> Tensor:
        return image.flatten(2).gather(2, corner + step).view(count, channels, *mask.shape[1:])

    upper = look_up(0) * (1 - across) + look_up(1) * across
    lower = look_up(width) * (1 - across) + look_up(width + 1) * across
    return torch.where(mask[:, None] > 0, upper * (1 - down) + lower * down, 0)


def _empty_outputs(image: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Room for the image, depth, mask and visible triangle."""
    return (
        image.new_empty(image.shape),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape, dtype=torch.int32),
    )


def _empty_gradients(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Room for the gradient of each."""
    image, depth, rotation, offset = (
        value.new_empty(value.shape) for value in (image, depth, rotation, offset)
    )
    return image, depth, rotation, offset


@torch.library.custom_op("derender::warp_numba", mutates_args=(), device_types="cpu")
def _numba(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.warping import numba_kernels

    outputs = _empty_outputs(image, depth)
    inputs = [array(value) for value in (image, depth, rotation, offset)]
    over_images(numba_kernels.forward, len(image), *inputs, focal, *(array(value) for value in outputs))
    return outputs


@torch.library.custom_op("derender::warp_numba_backward", mutates_args=(), device_types="cpu")
def _numba_backward(
    grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
    offset: Tensor, triangle: Tensor, focal: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    from derender.render.numba_threads import array, over_images
    from derender.render.warping import numba_kernels

    gradients = _empty_gradients(image, depth, rotation, offset)
    inputs = (grad_colour, grad_depth_seen, image, depth, rotation, offset)
    over_images(
        numba_kernels.backward, len(image),
        *(array(value) for value in inputs), focal, array(triangle), *(array(value) for value in gradients),
    )  # fmt: skip
    return gradients


@torch.library.custom_op("derender::warp_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _triton(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    from derender.render.warping import triton_kernels

    outputs = _empty_outputs(image, depth)[:3]
    image, depth, rotation, offset = (value.contiguous() for value in (image, depth, rotation, offset))
    _, channels, height, width = image.shape
    bits, pixels = float64_bits(focal), height * width
    motion = rotation, offset
    one = torch.empty(depth.shape, dtype=torch.float64, device=depth.device)
    screen = one, torch.empty_like(one), torch.empty_like(one)
    launch(triton_kernels.project_depth, depth, pixels, depth, *motion, *screen, bits, height, width)
    triangle = mark_triangles(screen)
    launch(
        triton_kernels.show, depth, pixels,
        image, depth, *motion, triangle, *outputs, bits, height, width, CHANNELS=channels,
    )  # fmt: skip
    return *outputs, triangle


@torch.library.custom_op("derender::warp_triton_backward", mutates_args=(), device_types=("cuda", "cpu"))
def _triton_backward(
    grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
    offset: Tensor, triangle: Tensor, focal: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    from derender.render.warping import triton_kernels

    count, channels, height, width = image.shape
    pixels = height * width
    inputs = [
        value.contiguous()
        for value in (grad_colour, grad_depth_seen, image, depth, rotation, offset, triangle)
    ]
    parts = count, programs_per_image(pixels, PIXELS_PER_PROGRAM), 3, 4
    grad_motion = torch.empty(parts, dtype=torch.float64, device=image.device)

    def run(mode, units, largest, targets) -> None:
        launch(
            triton_kernels.show_backward, depth, pixels,
            *inputs, grad_motion, *targets, units, largest, float64_bits(focal), height, width,
            CHANNELS=channels, MODE=mode,
        )  # fmt: skip

    shapes = [tuple(image.shape), tuple(depth.shape)]
    grad_image, grad_depth = scattered_sums(run, depth, shapes, [image.dtype, torch.float64])
    motion = grad_motion.sum(1)
    return grad_image, grad_depth.to(depth.dtype), motion[..., :3].contiguous(), motion[..., 3].contiguous()


def _connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and register both's shapes for torch.compile."""

    def outputs(
        image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _empty_outputs(image, depth)

    def gradients(
        grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
        offset: Tensor, triangle: Tensor, focal: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        return _empty_gradients(image, depth, rotation, offset)

    def set_up(ctx, inputs, output) -> None:
        *values, ctx.focal = inputs
        ctx.mark_non_differentiable(output[2], output[3])
        ctx.save_for_backward(*values, output[3])

    def differentiate(ctx, grad_colour: Tensor, grad_depth: Tensor, *_) -> tuple[Tensor | None, ...]:
        return *backward(grad_colour, grad_depth, *ctx.saved_tensors, ctx.focal), None

    forward.register_fake(outputs)
    backward.register_fake(gradients)
    forward.register_autograd(differentiate, setup_context=set_up)


_connect(_numba, _numba_backward)
_connect(_triton, _triton_backward)
FORWARD = {"numba": _numba, "triton": _triton}
"""By backend: image, depth, rotation, offset (float64), focal length to image, depth, mask, triangle."""
