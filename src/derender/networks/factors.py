"""The factors that an image is decomposed into: one declared row each, so that a fifth is a new row."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.nn.functional import pad

from derender.networks.decoders import MapDecoder, VectorDecoder
from derender.networks.encoders import Encoder, Images, NetworkSettings, UNetEncoder, activations
from derender.scene.camera import focal_px, shared_tensor
from derender.scene.perturb import PerturbSettings, exchange, perturb_camera, perturb_light
from derender.scene.ranges import SceneRanges


class FactorNet(nn.Module):
    """Encoder and decoder of one factor, image (0..1) to code and code to the value before its range."""

    def __init__(self, encoder: Encoder | UNetEncoder, decoder: nn.Module):
        super().__init__()
        self.encoder, self.decoder, self.code_size = encoder, decoder, encoder.code_size

    def activations(self, images: Images) -> Float[Tensor, "n _"]:
        """The code, followed by the encoder's last spatial map."""
        spatial = self.encoder.spatial(images)
        return activations(self.encoder.to_code(spatial).flatten(1), spatial)

    def forward(self, images: Images) -> Tensor:
        return self.decoder(self.encoder(images))


@dataclass(frozen=True)
class Number:
    """One number of a factor: its name in reports, its range, and whether it is even in its logarithm."""

    name: str
    low: float
    high: float
    log: bool = False
    start: float = 0.5  # share of the range, between 0 and 1, at which an untrained network begins

    def at(self, share: Tensor) -> Tensor:
        """The value at shares of the range, 0..1."""
        if self.log:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share


@dataclass(frozen=True)
class Factor:
    """One row: what the factor is called, how it is predicted, what it means and how it is perturbed."""

    name: str  # key of the network and of the feature column
    parameter: str  # the field of `Scene` (or key of ``Scene.extra``) that it fills
    build: Callable[[NetworkSettings], FactorNet]  # makes the factor's network
    to_parameter: Callable[[Tensor, SceneRanges], Tensor]  # gives a raw network output its physical range
    mirrored: bool  # whether the parameter is a map that the flipped twin of a scene shows mirrored
    # draws, for each row, another physically possible value; None if LOOCC never perturbs it
    perturb: Callable[[Tensor, Generator, PerturbSettings, SceneRanges], Tensor] | None
    numbers: tuple[Number, ...] = ()  # each column for reports and sliders; none of a map, no mirror changes
    rate: float = 1.0  # share of the learning rate at which its network is trained


def numbers_factor(name: str, *numbers: Number, rate: float = 1.0) -> Factor:
    """A row of a few numbers, ``Scene.extra[name]`` (N, K); LOOCC draws each anew from its range."""
    from_raw, drawn = partial(_ranged, numbers), partial(_drawn, numbers)
    return Factor(name, name, vector_net(len(numbers)), from_raw, False, drawn, numbers, rate)


def _valued(numbers: tuple[Number, ...], shares: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    return torch.stack([one.at(share) for one, share in zip(numbers, shares.unbind(1), strict=True)], 1)


def _drawn(numbers: tuple[Number, ...], value: Tensor, generator: Generator, *_: object) -> Tensor:
    return _valued(numbers, torch.rand(value.shape, generator=generator, device=generator.device).to(value))


def _ranged(numbers: tuple[Number, ...], raw: Float[Tensor, "n k"], ranges: SceneRanges) -> Tensor:
    share = raw.float() / 2 + 0.5
    odds = share.new_tensor([one.start / (1 - one.start) for one in numbers])
    return _valued(numbers, odds * share / (1 - share + odds * share))


def depth_from_raw(raw: Float[Tensor, "n 1 h w"], ranges: SceneRanges) -> Float[Tensor, "n h w"]:
    """Centre each map, squash it into the depth range and hold both side borders at the border depth."""
    raw = raw.float()
    centred = (raw - raw.mean(dim=(1, 2, 3), keepdim=True)).squeeze(1)
    height, width = centred.shape[-2:]
    half, middle = (ranges.depth_max - ranges.depth_min) / 2, (ranges.depth_max + ranges.depth_min) / 2
    if ranges.level_depth:
        centred = level(centred)
    if ranges.lean_deg:
        up = ((height - 1) / 2 - torch.arange(height, device=raw.device)) / focal_px(width, ranges.fov_deg)
        centred = centred + math.tan(math.radians(ranges.lean_deg)) * up[:, None] / half
    depth = middle + half * centred.tanh()
    columns = ranges.border_columns(width)
    return pad(depth[..., columns : width - columns], (columns, columns), value=ranges.border_depth)


def level(values: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """Take away each map's slope from top to bottom, measured under a window that is 0 beyond the edges."""
    height, width = values.shape[-2:]
    down = torch.linspace(-1, 1, height, device=values.device)[:, None]
    across, along = (
        torch.hann_window(size + 2, periodic=False, device=values.device)[1:-1] for size in (width, height)
    )
    window = along[:, None] * across
    slope = (window * down * values).sum(dim=(1, 2)) / (window * down.square()).sum()
    return values - slope[:, None, None] * down


def albedo_from_raw(raw: Float[Tensor, "n 3 h w"], ranges: SceneRanges) -> Float[Tensor, "n 3 h w"]:
    """Reflectance in 0..1."""
    return raw.float().tanh() / 2 + 0.5


def light_from_raw(raw: Float[Tensor, "n 4"], ranges: SceneRanges) -> Float[Tensor, "n 4"]:
    """Ambient, diffuse, pitch, yaw from numbers in -1..1; the last two are slopes: angles are arctangents."""
    raw = raw.float()
    ends = enumerate((ranges.ambient, ranges.diffuse))
    intensity = [low + (high - low) * (raw[:, i] / 2 + 0.5) for i, (low, high) in ends]
    pitch, yaw = (raw[:, 2:] * math.tan(math.radians(ranges.light_deg))).atan().unbind(1)
    return torch.stack([*intensity, pitch, yaw], dim=1)


def camera_from_raw(raw: Float[Tensor, "n 6"], ranges: SceneRanges) -> Float[Tensor, "n 6"]:
    """Rotation (radians) and translation from numbers in -1..1."""
    scale = [_radians(ranges.rotation_deg)] * 3 + [ranges.translation_xy] * 2 + [ranges.translation_z]
    return raw.float() * shared_tensor(tuple(scale), raw.device, torch.float32)


@cache
def _radians(angle_deg: float) -> float:
    """As torch rounds it in float32."""
    return torch.deg2rad(torch.tensor(angle_deg)).item()


def map_net(channels: int, initial_scale: float = 1.0) -> Callable[[NetworkSettings], FactorNet]:
    """Builder of a network for an image-sized map, whose last layer's first weights are scaled."""
    return partial(_map_net, channels, initial_scale)  # a local function could not be pickled


def _map_net(channels: int, initial_scale: float, settings: NetworkSettings) -> FactorNet:
    if settings.encoder == "unet":
        encoder = UNetEncoder(settings, settings.code_size)
    else:
        encoder = Encoder(settings, settings.width, settings.code_size, normalised=True)
    decoder = MapDecoder(settings, channels)
    with torch.no_grad():
        decoder.last.weight.mul_(initial_scale)
    return FactorNet(encoder, decoder)


def vector_net(numbers: int) -> Callable[[NetworkSettings], FactorNet]:
    """Builder of a network that predicts a few numbers in -1..1."""
    return partial(_vector_net, numbers)


def _vector_net(numbers: int, settings: NetworkSettings) -> FactorNet:
    encoder = Encoder(settings, settings.light_width, settings.code_size, normalised=False)
    return FactorNet(encoder, VectorDecoder(settings.code_size, numbers))


GEOMETRY_START = 0.1  # of geometry's last layer's first weights: depth begins almost flat; runs may differ

FACTORS = (
    Factor("geometry", "depth", map_net(1, GEOMETRY_START), depth_from_raw, mirrored=True, perturb=exchange),
    Factor("albedo", "albedo", map_net(3), albedo_from_raw, mirrored=True, perturb=exchange),
    Factor("light", "light", vector_net(4), light_from_raw, mirrored=False, perturb=perturb_light),
    Factor("camera", "camera", vector_net(6), camera_from_raw, mirrored=False, perturb=perturb_camera),
)
