"""`phong`: a glossy highlight on the matt surface, of one strength and exponent per image.

Blinn's half vector, h = (l + v) / |l + v| (Blinn, SIGGRAPH 1977): its lobes stay round at grazing angles and
need no clamp of the reflected ray. The highlight is strength * diffuse * max(0, n.h)^exponent where n.l > 0,
in the light's colour. The viewer stands where the scene's camera is, so a highlight moves with the view.
Leaves out Fresnel's law, and gloss that varies over the surface.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from derender.networks.factors import Number, numbers_factor
from derender.renderers.renderer import Maps, Renderer
from derender.scene import Scene
from derender.scene.camera import to_canonical, unproject
from derender.scene.light import light_direction
from derender.scene.normals import normals_from_depth

SPECULAR = numbers_factor(
    "specular", Number("strength", 0.0, 0.5, start=0.03), Number("exponent", 1.0, 128.0, log=True), rate=0.25
)  # on a shape that is still flat a strong highlight is a veil, and stays one


def phong(gamma: float = 1.0, mean_diffuse: float = 0.0) -> Renderer:
    """Lambert's image plus a highlight.

    ``gamma``, 1..3: light is added in values to this power; 2.2 is linear light of sRGB images.
    ``mean_diffuse``, 0..10: weight of (mean shading - 0.5)^2, which keeps a highlight from standing for the
    diffuse light (after RADAR, Zhang et al., CVPR 2021).
    """
    for name, value, low, high in (("gamma", gamma, 1, 3), ("mean_diffuse", mean_diffuse, 0, 10)):
        if not low <= value <= high:
            raise ValueError(f"renderer 'phong': {name} must lie in {low}..{high}, got {value:g}")

    return Renderer(
        "phong", (SPECULAR,), specular=highlight, gamma=gamma, maps={"highlight": _map},
        penalty=partial(_penalty, mean_diffuse) if mean_diffuse else None,
    )  # fmt: skip


def highlight(scene: Scene, normal: Float[Tensor, "n h w 3"], fov_deg: float) -> Float[Tensor, "n 1 h w"]:
    """Light that the surface reflects towards the scene's camera, from 0 on; ``normal`` points inwards."""
    strength, exponent = scene.extra["specular"][:, :, None, None].unbind(1)
    points = unproject(scene.depth, fov_deg)
    eye = to_canonical(torch.zeros_like(scene.camera[:, None, None, :3]), scene.camera)
    lamp = light_direction(scene.light)[:, None, None]
    half = normalize(lamp + normalize(points - eye, dim=-1), dim=-1)
    lit = (normal * lamp).sum(dim=-1) > 0
    cosine = (normal * half).sum(dim=-1)
    lobe = torch.where(lit & (cosine > 1e-4), cosine, 1.0) ** exponent * (lit & (cosine > 1e-4))
    return (strength * scene.light[:, 1, None, None] * lobe)[:, None]


def _penalty(mean_diffuse: float, scene: Scene, shading: Tensor) -> Tensor:
    return mean_diffuse * (shading.mean(dim=(1, 2, 3)) - 0.5).square().mean()


def _map(scene: Scene, fov_deg: float) -> Maps:
    return highlight(scene, normals_from_depth(scene.depth, fov_deg), fov_deg)[:, 0]
