"""Bilinear look-up of an image at pixel coordinates, in pixels throughout.

Coordinates are those of ``rasterize``: inside the image but for its edge tolerance, beyond which the border
cell is continued linearly. ``grid_sample`` is not used: normalising coordinates to -1..1 and back costs the
identity camera its exactness, and on the CPU most of the time. Same backends as ``rasterize``.
"""

from jaxtyping import Float
from torch import Tensor

from derender.render.rasterize import chosen_backend
from derender.render.sample import numba_cpu, reference, triton_gpu

IMPLEMENTATIONS = {"reference": reference, "numba": numba_cpu, "triton": triton_gpu}


def sample(
    image: Float[Tensor, "n c h w"],
    uv: Float[Tensor, "n h2 w2 2"],
    mask: Float[Tensor, "n h2 w2"],
    backend: str = "auto",
) -> Float[Tensor, "n c h2 w2"]:
    """The image's value at each (u, v); 0 with no gradient where the mask is 0."""
    return IMPLEMENTATIONS[chosen_backend(image.device, backend)].sample(image, uv, mask)
