"""U-Net encoders distilled from a trained model: they learn its scenes pixel by pixel.

Segmentation needs features at every resolution, and training by rendering reaches a U-Net's fine levels only
through a code of 1x1 pixels. A trained model knows more of every pixel that its surface covers: the pixel's
place on the object, its depth, and the object's colour there. The geometry encoder learns the first two, the
albedo encoder the last, each through the expanding half of a U-Net that is thrown away. A decoder over both,
which is kept, learns all of it from their features without changing them. Images and targets are zoomed,
moved and mirrored together. Both also learn the model's own codes of images as they are. Needs no labels.
Leaves out light and camera, whose encoders stay.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor, nn
from torch.nn.functional import affine_grid, grid_sample

from derender.data import Progress, as_float
from derender.model import Derenderer
from derender.networks.encoders import PIXEL_CHANNELS, Images, Pixels, UNetDecoder, UNetEncoder
from derender.objectives.reconstruction import masked_l1
from derender.render import warp
from derender.training.distillation import MEASURED_IMAGES, Student, StudentSettings

ZOOM = (0.7, 1.25)
SHIFT = 0.15
CONTRAST = (0.8, 1.2)
BRIGHTNESS = 0.1


class UNetSettings(StudentSettings):
    """How the U-Net encoders learn; ``images`` counts an image as often as it is seen."""

    images: int = Field(default=96_000, ge=1)
    batch_size: int = Field(default=32, ge=2)
    learning_rate: float = Field(default=1e-3, gt=0)
    weight_decay: float = Field(default=1e-4, ge=0)
    code_weight: float = Field(default=0.1, ge=0)  # of codes beside pixels
    unet_width: int = Field(default=16, ge=1)  # first channels of the U-Nets
    precision: Literal["32-true", "bf16-mixed"] = "32-true"  # of the students alone


@dataclass(frozen=True)
class PixelTargets:
    """A model's predictions for each pixel of a batch.

    ``maps``, by factor, are (N, 3, H, W): geometry is the place on the object (-1..1 across and down) and the
    depth (-1..1 over the model's range, without the camera's distance). Albedo is 0..1. All are 0 where
    nothing is covered. ``mask`` (N, H, W) is 1 where the surface is visible; ``codes`` are (N, code).
    """

    maps: dict[str, Tensor]
    mask: Tensor
    codes: dict[str, Tensor]


def distil_unets(
    model: Derenderer, images: Pixels, settings: UNetSettings | None = None, *,
    seed: int = 0, progress: Progress | None = None,
) -> Student:  # fmt: skip
    """A copy of a trained model with U-Net encoders of geometry and albedo and a decoder that learnt from it.

    It has no whitening or fitting. Its mean absolute errors on up to 256 images are "place" (pixels), "depth"
    (share of the range), "albedo" (0..1), and "reconstruction" beside "reconstruction before".
    The same seed gives the same weights on the same machine and thread count; torch's global random state is
    neither read nor changed. A ValueError are fewer than two images, images of another size, a grown model,
    one that lacks a factor, and weights of NaN or infinity.
    """
    settings = settings or UNetSettings()
    if len(images) < 2 or images.shape[-1] != model.image_size:
        got = f"got {len(images)} of {images.shape[-1]}"
        raise ValueError(f"U-Nets need 2 images or more of {model.image_size} pixels to learn from, {got}")
    if (smaller := model.settings.network.grown_from) is not None:
        raise ValueError(f"a model grown from {smaller} pixels takes no U-Nets: give the smaller model")
    for name in PIXEL_CHANNELS:
        if name not in model.nets:
            raise ValueError(f"the model has no {name}: U-Nets learn the paper's factors only")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        student = _with_unets(model, settings.unet_width)
        encoders = _encoders(student).items()
        decoders = {name: UNetDecoder(encoder.widths, 1, PIXEL_CHANNELS[name]) for name, encoder in encoders}
        heads = nn.ModuleDict(decoders).to(model.device)
    _learn(model, student, heads, images, settings, Generator().manual_seed(seed), progress)
    return Student(student, _errors(model, student, heads, images[:MEASURED_IMAGES]))


def _with_unets(model: Derenderer, width: int) -> Derenderer:
    """The model with fresh U-Net encoders of geometry and albedo and a decoder, all else as it was."""
    changes = {"encoder": "unet", "unet_width": width, "unet_decoder": True}
    network = model.settings.network.model_copy(update=changes)
    settings = model.settings.model_copy(update={"network": network})
    student = Derenderer(settings, model.factors, model.renderer)
    fresh = ("unet_decoder.", *(f"nets.{name}.encoder." for name in PIXEL_CHANNELS))
    kept = {name: value for name, value in model.state_dict().items() if not name.startswith(fresh)}
    student.load_state_dict(student.state_dict() | kept)
    return student.to(model.device).requires_grad_(False)


def _encoders(model: Any) -> dict[str, UNetEncoder]:
    """The U-Nets of geometry and albedo."""
    return {name: model.nets[name].encoder for name in PIXEL_CHANNELS}


def _learn(
    model: Derenderer, student: Derenderer, heads: nn.ModuleDict, images: Pixels,
    settings: UNetSettings, generator: Generator, progress: Progress | None,
) -> None:  # fmt: skip
    joint, encoders = student.unet_decoder, _encoders(student)
    assert joint is not None
    alone = nn.ModuleList([*encoders.values(), heads])
    learning = nn.ModuleList([alone, joint])
    learning.requires_grad_(True).train().to(memory_format=torch.channels_last)  # pyrefly: ignore[no-matching-overload]
    rate, decay = settings.learning_rate, settings.weight_decay
    optimiser = torch.optim.AdamW(learning.parameters(), rate, weight_decay=decay)
    with torch.no_grad():
        codes = model.encode(as_float(images[:MEASURED_IMAGES]).to(model.device))
    deviation = {name: codes[name].std(dim=0) for name in PIXEL_CHANNELS}
    scale = {name: value.clamp(min=0.1 * float(value.mean()) + 1e-6) for name, value in deviation.items()}

    def loss(rows: Tensor) -> Tensor:
        shown = as_float(images[rows]).to(model.device)
        targets = pixel_targets(model, shown)
        straight = len(rows) // 2  # these stay as they are: codes are of whole images
        shown, maps, mask = augmented(shown, targets, straight, generator)
        shown = shown.contiguous(memory_format=torch.channels_last)
        with torch.autocast(model.device.type, torch.bfloat16, enabled=settings.precision == "bf16-mixed"):
            skips = {name: encoder.skips(shown) for name, encoder in encoders.items()}
            own = {name: heads[name](levels) for name, levels in skips.items()}
            codes = {name: encoder.to_code(skips[name][-1]) for name, encoder in encoders.items()}
            joined = joint([torch.cat(level, dim=1).detach() for level in zip(*skips.values(), strict=True)])
        total = shown.new_zeros(())
        pieces = joined.float().split([*PIXEL_CHANNELS.values()], dim=1)
        for name, piece in zip(PIXEL_CHANNELS, pieces, strict=True):
            total = total + masked_l1(own[name].float(), maps[name], mask)
            total = total + masked_l1(piece, maps[name], mask)
            difference = codes[name].flatten(1)[:straight].float() - targets.codes[name][:straight]
            total = total + settings.code_weight * (difference / scale[name]).square().mean()
        return total

    parts = [alone, joint]  # each is clipped by itself: encoders learn as if there were no decoder over both
    report = progress or (lambda *_: None)
    how = {"warm_up": 0.1, "clipped": parts}
    settings.learn("the U-Nets' training", student, optimiser, loss, len(images), generator, report, **how)
    learning.eval().requires_grad_(False)
    student.eval()


@torch.no_grad()
def pixel_targets(model: Derenderer, images: Images) -> PixelTargets:
    """A model's predictions for each pixel of images in 0..1."""
    codes = model.encode(images)
    scene = model.decode(codes)
    side, ranges = images.shape[-1], model.settings.ranges
    line = torch.linspace(-1, 1, side, device=images.device)
    places = torch.stack(torch.meshgrid(line, line, indexing="xy")).expand(len(images), -1, -1, -1)
    seen = warp(torch.cat([places, scene.albedo], dim=1), scene.depth, scene.camera, model.fov_deg)
    middle, half = (ranges.depth_max + ranges.depth_min) / 2, (ranges.depth_max - ranges.depth_min) / 2
    away = scene.camera[:, 5, None, None]  # the camera's distance is another factor's
    depth = (seen.depth - away - middle) / half * seen.mask
    geometry = torch.cat([seen.image[:, :2], depth.unsqueeze(1)], dim=1)
    return PixelTargets({"geometry": geometry, "albedo": seen.image[:, 2:]}, seen.mask, codes)


def augmented(
    images: Images, targets: PixelTargets, straight: int, generator: Generator
) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Images, maps and mask, all but the first ``straight`` zoomed, moved, mirrored and lit otherwise."""
    count, device = len(images), images.device

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator) * (high - low) + low

    zoom, shift = uniform(*ZOOM), uniform(-SHIFT, SHIFT, 2)
    side = torch.where(uniform(0, 1) < 0.5, -1.0, 1.0)
    contrast, brightness = uniform(*CONTRAST, 3, 1, 1), uniform(-BRIGHTNESS, BRIGHTNESS, 1, 1, 1)
    zoom[:straight], side[:straight], shift[:straight] = 1, 1, 0
    contrast[:straight], brightness[:straight] = 1, 0
    moves = torch.zeros(count, 2, 3)
    moves[:, 0, 0], moves[:, 1, 1], moves[:, :, 2] = zoom * side, zoom, shift
    grid = affine_grid(moves, list(images.shape), align_corners=False).to(device)
    shown = grid_sample(images, grid, padding_mode="reflection", align_corners=False)
    shown = (shown * contrast.to(device) + brightness.to(device)).clamp(0, 1)
    joined = torch.cat([*targets.maps.values(), targets.mask.unsqueeze(1)], dim=1)
    *maps, mask = grid_sample(joined, grid, align_corners=False).split([*PIXEL_CHANNELS.values(), 1], dim=1)
    moved = dict(zip(targets.maps, maps, strict=True))
    moved["geometry"][:, 0] *= side.to(device).view(-1, 1, 1)  # a mirror image shows the other side
    return shown, moved, (mask[:, 0] > 0.99).float()


@torch.no_grad()
def _errors(model: Derenderer, student: Derenderer, heads: nn.ModuleDict, images: Pixels) -> dict[str, float]:
    shown = as_float(images).to(model.device)
    targets = pixel_targets(model, shown)
    own = {name: heads[name](encoder.skips(shown)) for name, encoder in _encoders(student).items()}
    geometry, place = targets.maps["geometry"], (model.image_size - 1) / 2
    errors = {
        "place": place * float(masked_l1(own["geometry"][:, :2], geometry[:, :2], targets.mask)),
        "depth": float(masked_l1(own["geometry"][:, 2:], geometry[:, 2:], targets.mask)) / 2,
        "albedo": float(masked_l1(own["albedo"], targets.maps["albedo"], targets.mask)),
    }
    for title, one in (("reconstruction", student), ("reconstruction before", model)):
        seen = one.reconstruct(shown)
        errors[title] = float(masked_l1(seen.image.clamp(0, 1), shown, seen.mask))
    return errors
