"""Show a canonical image, painted on the surface of a depth map, to a camera.

The surface's grid mesh is moved, rasterised (``rasterize``), and its colours looked up (``sample``).
``reference`` composes the definitions of those two; ``numba`` and ``triton`` do it all in one pass over the
picture, storing neither the moved points nor the canonical coordinates. They give the same picture, but for
rounding, and the same gradients.
"""

from jaxtyping import Float
from torch import Tensor

from derender.render.rasterize import chosen_backend
from derender.render.warping import numba_cpu, reference, triton_gpu
from derender.scene.camera import motion

IMPLEMENTATIONS = {"reference": reference, "numba": numba_cpu, "triton": triton_gpu}


def warp(
    image: Float[Tensor, "n c h w"],
    depth: Float[Tensor, "n h w"],
    camera: Float[Tensor, "n 6"],
    fov_deg: float,
    backend: str = "auto",
) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
    """Picture, depth and mask as the camera sees them; 0 where nothing is seen."""
    implementation = IMPLEMENTATIONS[chosen_backend(depth.device, backend)]
    return implementation.warp(image, depth, *motion(camera.double()), fov_deg)
