"""Views of images that only a model can show: their scenes in other light, or turned, by another camera."""

import math
from collections.abc import Iterable, Iterator

import torch
from jaxtyping import Float, Int64, Shaped
from torch import Generator, Tensor

from derender.data import Progress, as_float
from derender.model import Derenderer
from derender.networks import Factor
from derender.render import unwarp, warp
from derender.scene import Scene
from derender.scene.light import lambert_shading
from derender.scene.normals import normals_from_depth
from derender.scene.perturb import PerturbSettings, perturb_camera
from derender.training.step import fill_uncovered

BATCH_SIZE = 128
LIGHT_DEG = (60.0, 80.0)  # how far pitch and yaw of the light of photographs go
TURNS = PerturbSettings(camera_pitch_deg=6, camera_yaw_deg=12)  # of photographs
GREY = 0.4  # share of photographs without colour
DARKEST = 0.1  # shading by which an image is divided, at least


def renderings(
    model: Derenderer, scene: Scene, images: Float[Tensor, "n 3 h w"], changing: Iterable[Factor],
    perturb: PerturbSettings, generator: Generator, count: int,
) -> list[Float[Tensor, "n 3 h w"]]:  # fmt: skip
    """The images, then renderings of their scenes with other values of these factors, all pixels filled."""
    shown, ranges = [images], model.settings.ranges
    for _ in range(count):
        changed = {
            factor.parameter: factor.perturb(scene.parameters[factor.parameter], generator, perturb, ranges)
            for factor in changing
            if factor.perturb is not None
        }
        rendering = model.render(scene.with_parameters(**changed))
        shown.append(fill_uncovered(rendering.image, rendering.mask, images))
    return shown


def photographs(
    model: Derenderer, scene: Scene, images: Float[Tensor, "n 3 h w"], generator: Generator, count: int,
    turns: PerturbSettings = TURNS,
) -> list[Float[Tensor, "n 3 h w"]]:  # fmt: skip
    """The images, then as often in light from any side, turned by ``turns``, by another camera; in 0..1."""
    shown, fov = [images], model.fov_deg
    normals = normals_from_depth(scene.depth, fov)
    # the images' own pixels lie on the surfaces; each is multiplied by the new shading over its own
    texture = unwarp(images, scene.depth, scene.camera, fov)
    texture = texture / lambert_shading(normals, scene.light).clamp(min=DARKEST)

    def drawn(low: float, high: float, *shape: int) -> Tensor:
        return (low + (high - low) * torch.rand(len(images), *shape, generator=generator)).to(images)

    for _ in range(count):
        slopes = [math.radians(end) * drawn(-1, 1) for end in LIGHT_DEG]
        light = torch.stack([0.02 + 0.6 * drawn(0, 1).square(), drawn(0.4, 1.3), *slopes], dim=1)
        camera = perturb_camera(scene.camera, generator, turns, model.settings.ranges)
        rendering = warp(texture * lambert_shading(normals, light), scene.depth, camera, fov)
        view = fill_uncovered(rendering.image, rendering.mask, images)
        view = view * (drawn(0.15, 0.6) / view.mean(dim=(1, 2, 3)).clamp(min=DARKEST)).view(-1, 1, 1, 1)
        grey = view.mean(dim=1, keepdim=True).expand_as(view)
        view = torch.where(drawn(0, 1, 1, 1, 1) < GREY, grey, view).clamp(0, 1)
        view = view ** drawn(-0.35, 0.35, 1, 1, 1).exp()
        noise = torch.randn(view.shape, generator=generator).to(view) * drawn(0, 0.02, 1, 1, 1)
        shown.append((view + noise).clamp(0, 1))
    return shown


def batches(
    model: Derenderer, images: Shaped[Tensor, "n 3 h w"], rows: Int64[Tensor, " k"], progress: Progress | None
) -> Iterator[tuple[int, Float[Tensor, "b 3 h w"]]]:
    """These rows of the images in batches, in 0..1 on the model's device, each with its place."""
    for start in range(0, len(rows), BATCH_SIZE):
        batch = images[rows[start : start + BATCH_SIZE].to(images.device)]
        yield start, (as_float(batch) if batch.dtype == torch.uint8 else batch.float()).to(model.device)
        if progress is not None:
            progress(min(start + BATCH_SIZE, len(rows)), len(rows))
