"""U-Net encoders taught by a trained model: what it says of pictures, they learn to say pixel by pixel; ours.

Segmentation needs features at every resolution, and training by rendering reaches a U-Net's fine levels only
through a code of 1x1 pixels. A trained model knows more of every pixel that its surface covers: where on the
thing it lies, how deep it is, what colour the thing has there. The geometry encoder learns the first two, the
albedo encoder the last, each through the expanding half of a U-Net that is thrown away; a decoder over both,
which is kept, learns all of it from their features without changing them. Pictures and what is said of them
are zoomed, moved and mirrored together. Both also learn the model's own codes of pictures as
they are, so that the copy takes pictures apart, too. Needs no labels. Leaves out light and camera, whose
encoders stay.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Generator, Tensor, nn
from torch.nn.functional import affine_grid, grid_sample

from derender.data import as_float
from derender.model import Derenderer
from derender.networks.encoders import UNetEncoder
from derender.networks.unet import PIXEL_CHANNELS, UNetDecoder
from derender.objectives.self_training import endless_order
from derender.render.renderer import warp
from derender.settings import Settings

ZOOM = (0.7, 1.25)
SHIFT = 0.15
CONTRAST = (0.8, 1.2)
BRIGHTNESS = 0.1
_MEASURED = 256

Progress = Callable[[int, int], object]
"""Called with (pictures seen, pictures in all) after every step."""


class TeachingSettings(Settings):
    """How long and how fast the encoders learn; ``images`` counts a picture as often as it is seen."""

    images: int = Field(default=96_000, ge=1)
    batch_size: int = Field(default=32, ge=2)
    learning_rate: float = Field(default=1e-3, gt=0)
    weight_decay: float = Field(default=1e-4, ge=0)
    code_weight: float = Field(default=0.1, ge=0)
    unet_width: int = Field(default=16, ge=1)
    precision: Literal["32-true", "bf16-mixed"] = "32-true"  # of what learns alone


DEFAULT_TEACHING = TeachingSettings()


@dataclass(frozen=True)
class Said:
    """What a model says of a batch of pictures.

    Attributes:
        maps: by factor; geometry (N, 3, H, W) is the place on the thing (-1..1 across and down) and the depth
            (-1..1 over the model's range, the camera's own distance taken off), albedo (N, 3, H, W) 0..1; 0
            where nothing is covered.
        mask: (N, H, W) 1 where the surface is seen.
        codes: by factor, (N, code).
    """

    maps: dict[str, Tensor]
    mask: Tensor
    codes: dict[str, Tensor]


@dataclass(frozen=True)
class Taught:
    """A model with U-Net encoders and a decoder over both, and how well the encoders learnt.

    Attributes:
        model: the copy, evaluated and without features of its own (whitening, fitting).
        errors: mean absolute error of up to 256 of the pictures as they are: "place" (pixels), "depth" (share
            of the range), "albedo" (0..1), and "reconstruction" of the copy beside "reconstruction before".
    """

    model: Derenderer
    errors: dict[str, float]


def teach_unets(
    model: Derenderer,
    images: UInt8[Tensor, "n 3 h w"],
    settings: TeachingSettings = DEFAULT_TEACHING,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> Taught:
    """A copy of a trained model with U-Net encoders of geometry and albedo and a decoder that learnt from it.

    The same seed gives the same weights on the same machine and thread count; torch's global random state is
    neither read nor changed, and the model stays as it is.

    Raises:
        ValueError: fewer than two pictures, pictures of another size, a model that lacks a factor, or weights
            that are no numbers in the end.
    """
    if len(images) < 2 or images.shape[-1] != model.image_size:
        raise ValueError(
            f"teaching needs 2 pictures or more of {model.image_size} pixels, got {len(images)} of "
            f"{images.shape[-1]}"
        )
    lacking = [name for name in PIXEL_CHANNELS if name not in model.nets]
    if lacking:
        raise ValueError(f"the model has no {lacking[0]}: only the paper's factors can be taught")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        student = _with_unets(model, settings.unet_width)
        heads = nn.ModuleDict(
            {
                name: UNetDecoder(_encoder(student, name).widths, 1, count)
                for name, count in PIXEL_CHANNELS.items()
            }
        ).to(model.device)
    _learn(model, student, heads, images, settings, Generator().manual_seed(seed), progress)
    if not all(bool(value.isfinite().all()) for value in student.state_dict().values()):
        raise ValueError(
            f"teaching ended in weights that are NaN or infinite after {settings.images:,} pictures: "
            "give another seed or a lower learning_rate"
        )
    return Taught(student, _errors(model, student, heads, images[:_MEASURED]))


def _with_unets(model: Derenderer, width: int) -> Derenderer:
    """The model with fresh U-Net encoders of geometry and albedo and a decoder, all else as it was."""
    fresh_parts = {"encoder": "unet", "unet_width": width, "unet_decoder": True}
    network = model.settings.network.model_copy(update=fresh_parts)
    student = Derenderer(
        model.settings.model_copy(update={"network": network}), model.factors, model.renderer
    )
    fresh = ("unet_decoder.", *(f"nets.{name}.encoder." for name in PIXEL_CHANNELS))
    kept = {name: value for name, value in model.state_dict().items() if not name.startswith(fresh)}
    student.load_state_dict(student.state_dict() | kept)
    return student.to(model.device).requires_grad_(False)


def _encoder(model: Derenderer, name: str) -> UNetEncoder:
    encoder = model.nets[name].encoder
    assert isinstance(encoder, UNetEncoder)
    return encoder


def _learn(
    model: Derenderer,
    student: Derenderer,
    heads: nn.ModuleDict,
    images: UInt8[Tensor, "n 3 h w"],
    settings: TeachingSettings,
    generator: Generator,
    progress: Progress | None,
) -> None:
    """Train the student's encoders and decoder and the heads in place."""
    joint = student.unet_decoder
    assert joint is not None
    alone = nn.ModuleList([*(_encoder(student, name) for name in PIXEL_CHANNELS), heads])
    learning = nn.ModuleList([alone, joint])
    learning.requires_grad_(True).train().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(
        learning.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
    )
    batch = min(settings.batch_size, len(images))
    steps = math.ceil(settings.images / batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=steps + 1, pct_start=0.1, cycle_momentum=False
    )
    spread = _code_spread(model, images[:_MEASURED])
    order = endless_order(len(images), generator)
    device = model.device.type
    for step in range(steps):
        rows = torch.tensor([next(order) for _ in range(batch)])
        pictures = as_float(images[rows]).to(model.device)
        said = said_of(model, pictures)
        straight = batch // 2  # these stay as they are: codes are of whole pictures
        shown, maps, mask = _seen_otherwise(pictures, said, straight, generator)
        shown = shown.contiguous(memory_format=torch.channels_last)
        loss = shown.new_zeros(())
        with torch.autocast(device, torch.bfloat16, enabled=settings.precision == "bf16-mixed"):
            skips = {name: _encoder(student, name).skips(shown) for name in PIXEL_CHANNELS}
            told = {name: heads[name](levels) for name, levels in skips.items()}
            codes = {name: _encoder(student, name).to_code(levels[-1]) for name, levels in skips.items()}
            told_jointly = joint(
                [torch.cat(level, dim=1).detach() for level in zip(*skips.values(), strict=True)]
            )
        own = told_jointly.float().split([*PIXEL_CHANNELS.values()], dim=1)
        for name, jointly in zip(PIXEL_CHANNELS, own, strict=True):
            loss = loss + _masked_error(told[name].float(), maps[name], mask)
            loss = loss + _masked_error(jointly, maps[name], mask)
            apart = (codes[name].flatten(1)[:straight].float() - said.codes[name][:straight]) / spread[name]
            loss = loss + settings.code_weight * apart.square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for part in learning:  # each by itself: encoders learn as if there were no decoder over both
            nn.utils.clip_grad_norm_(part.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if progress is not None:
            progress(min((step + 1) * batch, settings.images), settings.images)
    learning.eval().requires_grad_(False)
    student.eval()


@torch.no_grad()
def said_of(model: Derenderer, pictures: Float[Tensor, "n 3 h w"]) -> Said:
    """What a model says of pictures in 0..1, as they lie in the picture."""
    codes = model.encode(pictures)
    scene = model.decode(codes)
    side, ranges = pictures.shape[-1], model.settings.ranges
    line = torch.linspace(-1, 1, side, device=pictures.device)
    places = torch.stack(torch.meshgrid(line, line, indexing="xy")).expand(len(pictures), -1, -1, -1)
    seen = warp(torch.cat([places, scene.albedo], dim=1), scene.depth, scene.camera, model.fov_deg)
    middle, half = (ranges.depth_max + ranges.depth_min) / 2, (ranges.depth_max - ranges.depth_min) / 2
    away = scene.camera[:, 5, None, None]  # how far the camera stands is said by its own factor
    depth = (seen.depth - away - middle) / half * seen.mask
    geometry = torch.cat([seen.image[:, :2], depth.unsqueeze(1)], dim=1)
    return Said({"geometry": geometry, "albedo": seen.image[:, 2:]}, seen.mask, codes)


def _seen_otherwise(
    pictures: Float[Tensor, "n 3 h w"], said: Said, straight: int, generator: Generator
) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Pictures, maps and mask, all but the first ``straight`` zoomed, moved, mirrored and lit otherwise."""
    count, device = len(pictures), pictures.device

    def drawn(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator) * (high - low) + low

    zoom, shift = drawn(*ZOOM), drawn(-SHIFT, SHIFT, 2)
    side = torch.where(drawn(0, 1) < 0.5, -1.0, 1.0)
    contrast, brightness = drawn(*CONTRAST, 3, 1, 1), drawn(-BRIGHTNESS, BRIGHTNESS, 1, 1, 1)
    zoom[:straight], side[:straight], shift[:straight] = 1, 1, 0
    contrast[:straight], brightness[:straight] = 1, 0
    moves = torch.zeros(count, 2, 3)
    moves[:, 0, 0], moves[:, 1, 1], moves[:, :, 2] = zoom * side, zoom, shift
    grid = affine_grid(moves, list(pictures.shape), align_corners=False).to(device)
    shown = grid_sample(pictures, grid, padding_mode="reflection", align_corners=False)
    shown = (shown * contrast.to(device) + brightness.to(device)).clamp(0, 1)
    joined = torch.cat([*said.maps.values(), said.mask.unsqueeze(1)], dim=1)
    *maps, mask = grid_sample(joined, grid, align_corners=False).split([*PIXEL_CHANNELS.values(), 1], dim=1)
    found = dict(zip(said.maps, maps, strict=True))
    found["geometry"][:, 0] *= side.to(device).view(-1, 1, 1)  # of the mirror image the other side is meant
    return shown, found, (mask[:, 0] > 0.99).float()


def _masked_error(
    told: Float[Tensor, "n c h w"], truth: Float[Tensor, "n c h w"], mask: Float[Tensor, "n h w"]
) -> Float[Tensor, ""]:
    """Mean absolute error over channels and the pixels that the mask keeps."""
    return ((told - truth).abs().mean(dim=1) * mask).sum() / mask.sum().clamp(min=1)


def _code_spread(model: Derenderer, images: UInt8[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
    """How much each number of the codes varies, at least a tenth of their mean spread."""
    with torch.no_grad():
        codes = model.encode(as_float(images).to(model.device))
    spread = {name: codes[name].std(dim=0) for name in PIXEL_CHANNELS}
    return {name: value.clamp(min=0.1 * float(value.mean()) + 1e-6) for name, value in spread.items()}


@torch.no_grad()
def _errors(
    model: Derenderer, student: Derenderer, heads: nn.ModuleDict, images: UInt8[Tensor, "n 3 h w"]
) -> dict[str, float]:
    """Mean absolute errors over pictures as they are; of ``Taught``."""
    pictures = as_float(images).to(model.device)
    said = said_of(model, pictures)
    told = {name: heads[name](_encoder(student, name).skips(pictures)) for name in PIXEL_CHANNELS}
    geometry, place = said.maps["geometry"], (model.image_size - 1) / 2
    found = {
        "place": place * float(_masked_error(told["geometry"][:, :2], geometry[:, :2], said.mask)),
        "depth": float(_masked_error(told["geometry"][:, 2:], geometry[:, 2:], said.mask)) / 2,
        "albedo": float(_masked_error(told["albedo"], said.maps["albedo"], said.mask)),
    }
    for title, one in (("reconstruction", student), ("reconstruction before", model)):
        seen = one.reconstruct(pictures)
        found[title] = float(_masked_error(seen.image.clamp(0, 1), pictures, seen.mask))
    return found
