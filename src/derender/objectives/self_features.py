"""Perceptual features learned without labels from the training images: a small frozen net, and its training.

The stage layout is VGG16's up to relu3_3 at a twenty-fifth of the multiplications, with average pooling, so
that the gradient reaches every pixel evenly. Self-supervised features do as well as VGG's in the ablation of
unsup3d (Wu et al., CVPR 2020, table 2). Training is dense contrastive learning: SimCLR's objective (Chen et
al. 2020) at feature locations, as in DenseCL (Wang et al. 2021), between two crops of each image.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Generator, Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from derender.objectives.loocc import nt_xent
from derender.objectives.perceptual import CALIBRATION_IMAGES, PerceptualFeatures
from derender.storage.bounded import parse_json
from derender.storage.tensors import read_described, write_tensors

Images = Float[Tensor, "n 3 h w"]

DEFAULT_WIDTHS = (16, 32, 64)
KIND = "self"  # in a file's metadata


class SelfFeatures(PerceptualFeatures):
    """Convolutions, ReLUs and average pooling: ``widths[-1]`` channels at a quarter of the resolution."""

    stride = 4

    def __init__(self, widths: tuple[int, int, int] = DEFAULT_WIDTHS):
        super().__init__(trunk(widths, normalised=False), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25))
        self.widths = tuple(widths)
        self.channels = widths[-1]

    def save(self, path: Path | str) -> None:
        """Write weights, scale and widths to one safetensors file."""
        write_tensors(self.state_dict(), path, {"kind": KIND, "widths": json.dumps(self.widths)})


def load_self_features(path: Path | str) -> SelfFeatures:
    """Read what ``SelfFeatures.save`` wrote."""
    try:
        tensors, metadata = read_described(path)
    except (ValueError, OSError) as problem:
        raise ValueError(f"the perceptual features in {path} cannot be read ({problem})") from problem
    if metadata.get("kind") != KIND or "widths" not in metadata:
        raise ValueError(f"{path} holds no self-trained perceptual features; something else wrote it")
    try:
        net = SelfFeatures(parse_json(metadata["widths"], tuple[int, int, int]))
        net.load_state_dict(tensors)
    except (RuntimeError, ValueError, TypeError) as problem:
        fix = "delete it, and they are learnt again"
        raise ValueError(f"{path} does not fit its own widths; {fix}") from problem
    return net


def trunk(widths: tuple[int, int, int], normalised: bool) -> nn.Sequential:
    """The layers of the net; ``normalised`` puts a BatchNorm after each convolution, for training."""
    if len(widths) != 3 or min(widths) < 1:
        raise ValueError(f"the self-trained features need three positive widths, got {widths}")
    full, half, quarter = widths
    layers: list[nn.Module] = []
    for place, (previous, channels) in enumerate(pairwise((3, full, half, half, quarter, quarter))):
        layers.append(nn.Conv2d(previous, channels, 3, padding=1, bias=not normalised))
        layers += [nn.BatchNorm2d(channels)] if normalised else []
        layers.append(nn.ReLU(inplace=True))
        layers += [nn.AvgPool2d(2)] if place in (0, 2) else []
    return nn.Sequential(*layers)


def without_normalisation(network: nn.Sequential) -> nn.Sequential:
    """What layers in evaluation mode compute, every BatchNorm folded into the convolution before it."""
    folded: list[Any] = []
    for layer in network:
        if isinstance(layer, nn.BatchNorm2d):
            folded[-1] = fuse_conv_bn_eval(folded[-1], layer)
        else:
            folded.append(layer)
    return nn.Sequential(*folded)


@dataclass(frozen=True)
class SelfTraining:
    """How the features are learned: 2 * ``batch`` * ``places`` locations are contrasted in a step."""

    widths: tuple[int, int, int] = DEFAULT_WIDTHS  # channels at full, half and quarter resolution
    batch: int = 32  # images
    places: int = 16  # locations sampled in each
    crop: int = 40  # side of the views in pixels, at most three quarters of the image
    projection: int = 64  # width of the head that is thrown away afterwards
    temperature: float = 0.2  # of NT-Xent
    learning_rate: float = 3e-3  # of AdamW, at its peak
    weight_decay: float = 1e-4


@torch.random.fork_rng(devices=[])  # building layers draws from the global state
def train_self_features(
    images: UInt8[Tensor, "n 3 h w"], *, seed: int, steps: int,
    progress: Callable[[int, int, float], None] | None = None, settings: SelfTraining = SelfTraining(),
) -> SelfFeatures:  # fmt: skip
    """Train on these images and freeze; ``progress(step, steps, loss)`` is called after every step.

    Calibrated on 256 of the images. The same seed gives the same weights on the same machine and thread
    count; torch's global random state is neither read nor changed.
    """
    if len(images) < 2:
        raise ValueError(f"self-trained perceptual features need at least 2 images, got {len(images)}")
    if steps < 1:
        raise ValueError(f"training perceptual features needs at least 1 step, got {steps}")
    generator = Generator().manual_seed(seed)
    net, width = SelfFeatures(settings.widths).to(images.device), settings.widths[-1]
    head = nn.Sequential(
        nn.Conv2d(width, 2 * width, 1), nn.ReLU(), nn.Conv2d(2 * width, settings.projection, 1)
    )
    layers = trunk(settings.widths, normalised=True)
    for module in [*layers, *head]:
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    learner = nn.Sequential(layers, head).to(images.device).train()
    rate, decay = settings.learning_rate, settings.weight_decay
    optimiser = torch.optim.AdamW(learner.parameters(), rate, weight_decay=decay)

    def loss(rows: Int64[Tensor, " b"]) -> Tensor:
        crops = images[rows].float() / 255
        pair = two_views(crops, settings.crop, SelfFeatures.stride, settings.places, generator)
        views = (torch.cat([pair.first, pair.second]) - net.image_mean) / net.image_std
        first, second = learner(views.contiguous(memory_format=torch.channels_last)).chunk(2)
        return nt_xent(_at(first, pair.first_places), _at(second, pair.second_places), settings.temperature)

    batch = min(settings.batch, len(images))
    for step, value in one_cycle(optimiser, loss, len(images), batch, steps, generator, warm_up=0.2):
        if progress is not None:
            progress(step, steps, value.item())
    if not all(bool(value.isfinite().all()) for value in layers.state_dict().values()):
        ended = f"learning perceptual features ended in weights that are NaN or infinite after {steps} steps"
        raise ValueError(f"{ended}: give another seed, or perceptual=none")
    net.features.load_state_dict(without_normalisation(layers.cpu().eval()).state_dict())
    rows = torch.randperm(len(images), generator=generator)[:CALIBRATION_IMAGES]
    net.calibrate_(images[rows].float() / 255)
    return net


def one_cycle(
    optimiser: torch.optim.Optimizer, loss: Callable[[Int64[Tensor, " b"]], Float[Tensor, ""]], count: int,
    batch: int, steps: int, generator: Generator, *, warm_up: float, clipped: Sequence[nn.Module] = (),
) -> Iterator[tuple[int, Float[Tensor, ""]]]:  # fmt: skip
    """Minimise a loss of rows of ``count`` images, drawn epoch by epoch, with one cycle of the rate.

    Gives the number of steps done and the loss after each. The optimiser's own rate is the peak, reached
    after the share ``warm_up`` of the steps; gradients of each of ``clipped`` are clipped to norm 1.
    """
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, optimiser.defaults["lr"], total_steps=steps + 1, pct_start=warm_up, cycle_momentum=False
    )
    order: list[int] = []
    for step in range(1, steps + 1):
        while len(order) < batch:
            order += torch.randperm(count, generator=generator).tolist()
        rows, order = order[:batch], order[batch:]
        value = loss(torch.tensor(rows))
        optimiser.zero_grad(set_to_none=True)
        value.backward()
        for part in clipped:
            nn.utils.clip_grad_norm_(part.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        yield step, value.detach()


@dataclass(frozen=True)
class ViewPair:
    """Two augmented crops (N, 3, crop, crop) of each image, 0..1, and where they show the same points."""

    first: Float[Tensor, "n 3 c c"]
    second: Float[Tensor, "n 3 c c"]
    first_places: Int64[Tensor, "n p"]  # of point p, as a flat index into that crop's feature map
    second_places: Int64[Tensor, "n p"]


def two_views(images: Images, crop: int, stride: int, places: int, generator: Generator) -> ViewPair:
    """Crop each image twice, mirror both crops alike, augment each by itself.

    Crops take at most three quarters of the image's side and are up to a quarter of the crop apart, by whole
    strides: feature locations correspond exactly.
    """
    n, _, height, width = images.shape
    crop = min(crop, 3 * min(height, width) // 4) // stride * stride
    if crop < 2 * stride:
        raise ValueError(f"images of {height} x {width} are too small for features of stride {stride}")
    cells = crop // stride
    reach = torch.tensor(max(1, cells // 4))
    corners = []
    for slack in (height - crop, width - crop):
        first = torch.randint(slack + 1, (n,), generator=generator)
        lowest = -torch.minimum(first // stride, reach)
        highest = torch.minimum((slack - first) // stride, reach)
        steps = lowest + (torch.rand(n, generator=generator) * (highest - lowest + 1)).long()
        corners.append(torch.stack([first, first + steps * stride]))
    first_corner, second_corner = torch.stack(corners, dim=2)
    offset = (second_corner - first_corner) // stride
    drawn = torch.rand((n, places, 2), generator=generator)
    extent = cells - offset.abs()
    first_cell = offset.clamp(min=0).unsqueeze(1) + (drawn * extent.unsqueeze(1)).long()
    second_cell = first_cell - offset.unsqueeze(1)
    mirrored = torch.rand((n, 1), generator=generator) < 0.5

    def flat(cell: Tensor) -> Tensor:
        column = torch.where(mirrored, cells - 1 - cell[..., 1], cell[..., 1])
        return (cell[..., 0] * cells + column).to(images.device)

    def view(corner: Tensor) -> Tensor:
        placed = zip(images, corner.tolist(), strict=True)
        cut = torch.stack([image[:, y : y + crop, x : x + crop] for image, (y, x) in placed])
        mirror = mirrored.view(-1, 1, 1, 1).to(cut.device)
        return photometric_augmentation(torch.where(mirror, cut.flip(3), cut), generator)

    return ViewPair(view(first_corner), view(second_corner), flat(first_cell), flat(second_cell))


def photometric_augmentation(images: Images, generator: Generator) -> Images:
    """Brightness, contrast, a colour cast and noise, drawn for each image; the result stays in 0..1."""
    # no blur: features that ignore it would not miss the detail that a blurred rendering lacks

    def draw(channels: int = 1) -> Tensor:
        return torch.rand(len(images), channels, 1, 1, generator=generator).to(images)

    mean = images.mean(dim=(1, 2, 3), keepdim=True)
    contrast, gain, cast = 0.7 + 0.6 * draw(), 0.7 + 0.6 * draw(), 0.9 + 0.2 * draw(3)
    changed = ((images - mean) * contrast + mean) * gain * cast
    noise = torch.randn(images.shape, generator=generator).to(images)
    return (changed + noise * 0.03 * draw()).clamp(0, 1)


def _at(codes: Float[Tensor, "n c h w"], places: Int64[Tensor, "n p"]) -> Float[Tensor, "np c"]:
    codes = codes.flatten(2)
    return codes.gather(2, places.unsqueeze(1).expand(-1, codes.shape[1], -1)).transpose(1, 2).flatten(0, 1)
