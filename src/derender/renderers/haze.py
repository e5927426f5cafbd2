"""`haze`: air between surface and camera that pales what is far (Koschmieder's law).

image = clear * t + A (1 - t), t = exp(-beta d). d is the distance in the camera's view, rescaled to 0..1 over
the surface that is seen. Over the whole depth range it would be an even veil, and any albedo explains that.
Leaves out coloured air, and light that the air scatters twice.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from derender.networks.factors import Number, numbers_factor
from derender.render import Rendering
from derender.renderers.renderer import Maps, Renderer
from derender.scene import Scene

HAZE = numbers_factor("haze", Number("beta", 0.2, 4.0, log=True), Number("airlight", 0.25, 1.0))
_FLATTEST = 1e-3  # scene units that count as a depth range at least


def haze() -> Renderer:
    """Haze in front of any other renderer's surface; has no settings."""
    return Renderer("haze", (HAZE,), atmosphere=through_haze, maps={"transmission": _map})


def through_haze(rendering: Rendering, scene: Scene) -> Rendering:
    """The rendering behind the scene's haze."""
    share = transmission(rendering.depth, rendering.mask, scene.extra["haze"][:, 0])[:, None]
    air = scene.extra["haze"][:, 1, None, None, None]
    image = rendering.image * share + air * (1 - share) * rendering.mask[:, None]
    return Rendering(image, rendering.depth, rendering.mask)


def transmission(depth: Maps, mask: Maps, beta: Float[Tensor, " n"]) -> Maps:
    """The share of light that passes: 1 at the nearest point seen, exp(-beta) at the farthest."""
    seen = mask > 0
    near = torch.where(seen, depth, torch.inf).amin(dim=(1, 2), keepdim=True)
    far = torch.where(seen, depth, -torch.inf).amax(dim=(1, 2), keepdim=True)
    distance = torch.where(seen, depth - near, 0.0) / (far - near).clamp(min=_FLATTEST)
    return (-beta[:, None, None] * distance).exp()


def _map(scene: Scene, fov_deg: float) -> Maps:
    return transmission(scene.depth, torch.ones_like(scene.depth), scene.extra["haze"][:, 0])
