"""Scenes to render, and what an image of them must be."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from derender.render import Rendering
from derender.render.rasterize import Fragments
from derender.scene.camera import pixel_rays

FOV_DEG = 10.0


def smooth_depth(
    count: int, height: int, width: int, generator: torch.Generator, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Gently rolling depth around 1."""
    noise = torch.randn(count, 1, height + 4, width + 4, generator=generator, dtype=torch.float64)
    return (1 + 0.02 * avg_pool2d(noise, 5, 1)[:, 0]).to(dtype)


def scene(
    count: int, height: int, width: int, generator: torch.Generator, dtype: torch.dtype = torch.float32,
    turn_rad: float = 0.4,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """depth, albedo, light, camera: a smooth surface with random colours under a moderate camera."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = smooth_depth(count, height, width, generator)
    light = torch.cat((0.2 + 0.6 * uniform(count, 2), uniform(count, 2) - 0.5), dim=1)
    shift = 0.02 * (uniform(count, 3) - 0.5)
    camera = torch.cat((turn_rad * 2 * (uniform(count, 3) - 0.5), shift), dim=1)
    values = (depth, uniform(count, 3, height, width), light, camera)
    return tuple(value.to(dtype) for value in values)


def camera(dtype: torch.dtype = torch.float64, **parts: float) -> Tensor:
    """One camera (1, 6) by named parts, the rest zero."""
    return torch.tensor([[parts.get(one, 0.0) for one in ("rx", "ry", "rz", "tx", "ty", "tz")]], dtype=dtype)


def rays(height: int, width: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return pixel_rays(height, width, FOV_DEG, dtype=dtype)


def pixel_grid(height: int, width: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """(H, W, 2): each pixel's own u and v."""
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack((u, v), dim=-1).to(dtype)


def assert_empty_outside(result: Rendering | Fragments) -> None:
    """Mask is 0 or 1, everything finite, and nothing but zeros outside the mask."""
    assert ((result.mask == 0) | (result.mask == 1)).all()
    outside = result.mask == 0
    places = result.image.movedim(1, -1) if isinstance(result, Rendering) else result.uv
    for values in (result.depth, places):
        assert values.isfinite().all()
        assert (values[outside] == 0).all()
