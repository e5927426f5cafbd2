"""Show a canonical image, painted on the surface of a depth map, to a camera.

The surface's grid mesh is moved, rasterised (``rasterize``), and its colours looked up. ``reference``
composes the definitions of those; ``numba`` and ``triton`` do it all in one pass over the image, storing
neither the moved points nor the canonical coordinates. They give the same image, but for rounding, and the
same gradients.
"""

from jaxtyping import Float
from torch import Tensor

from derender.render.backends import chosen_backend
from derender.render.warping import operators, reference
from derender.scene.camera import focal_px, motion


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
        return reference.warp(image, depth, rotation, offset, fov_deg)
    return operators.FORWARD[chosen](image, depth, rotation, offset, focal_px(depth.shape[2], fov_deg))[:3]
