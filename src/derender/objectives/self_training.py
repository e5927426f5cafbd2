"""Learn perceptual features from unlabelled pictures: recognise a place in two augmented views.

Each picture is cropped twice at places that differ by whole feature strides, and each crop gets its own
brightness, contrast, colour and noise. Locations that show the same point of the same picture are positives;
every other sampled location, of this picture or another, is a negative (NT-Xent, instance discrimination at
the level of places). Source: SimCLR (Chen et al. 2020) for the objective; the dense variant follows the idea
of DenseCL (Wang et al. 2021) with exact correspondences. Leaves out a momentum encoder and a queue: a batch
holds thousands of places already.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Generator, Tensor, nn

from derender.objectives.loocc import nt_xent
from derender.objectives.self_features import DEFAULT_WIDTHS, SelfFeatures, trunk, without_normalisation

DEFAULT_STEPS = 600
_CALIBRATION_PICTURES = 256


@dataclass(frozen=True)
class SelfTraining:
    """How the features are learned.

    Attributes:
        widths: channels at full, half and quarter resolution.
        batch: pictures a step.
        places: locations sampled in each picture; a step contrasts 2 * batch * places of them.
        crop: side of the views in pixels, at most three quarters of the picture.
        projection: width of the head that is thrown away afterwards.
        temperature: of NT-Xent.
        learning_rate, weight_decay: AdamW's; the rate is the peak of a one-cycle schedule.
    """

    widths: tuple[int, int, int] = DEFAULT_WIDTHS
    batch: int = 32
    places: int = 16
    crop: int = 40
    projection: int = 64
    temperature: float = 0.2
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4


def train_self_features(
    images: UInt8[Tensor, "n 3 h w"],
    *,
    seed: int,
    steps: int | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    device: torch.device | str = "cpu",
    settings: SelfTraining = SelfTraining(),
) -> SelfFeatures:
    """Train on these pictures and freeze; ``progress(step, steps, loss)`` is called after every step.

    Calibrated on 256 of the pictures. The same seed gives the same weights on the same machine and thread
    count; torch's global random state is neither read nor changed.
    """
    if len(images) < 2:
        raise ValueError(f"self-trained perceptual features need at least 2 pictures, got {len(images)}")
    steps = DEFAULT_STEPS if steps is None else steps
    if steps < 1:
        raise ValueError(f"training perceptual features needs at least 1 step, got {steps}")
    with torch.random.fork_rng(devices=[]):  # building layers draws from the global state before we do
        return _trained(images, Generator().manual_seed(seed), steps, progress, device, settings)


def _trained(
    images: UInt8[Tensor, "n 3 h w"],
    generator: Generator,
    steps: int,
    progress: Callable[[int, int, float], None] | None,
    device: torch.device | str,
    settings: SelfTraining,
) -> SelfFeatures:
    layers, head = _initialised(settings, generator)
    layers, head = layers.to(device).train(), head.to(device).train()
    frame = SelfFeatures(settings.widths).to(device)
    parameters = [*layers.parameters(), *head.parameters()]
    optimiser = torch.optim.AdamW(parameters, settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=steps + 1, pct_start=0.2, cycle_momentum=False
    )
    batch = min(settings.batch, len(images))
    order = endless_order(len(images), generator)
    for step in range(steps):
        rows = torch.tensor([next(order) for _ in range(batch)])
        pictures = images[rows].to(device).float() / 255
        pair = two_views(pictures, settings.crop, SelfFeatures.stride, settings.places, generator)
        views = (torch.cat([pair.first, pair.second]) - frame.image_mean) / frame.image_std
        codes = head(layers(views.contiguous(memory_format=torch.channels_last)))
        first, second = codes.chunk(2)
        loss = nt_xent(_at(first, pair.first_places), _at(second, pair.second_places), settings.temperature)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
        if progress is not None:
            progress(step + 1, steps, loss.item())
    if not all(bool(value.isfinite().all()) for value in layers.state_dict().values()):
        raise ValueError(
            f"learning perceptual features ended in weights that are NaN or infinite after {steps} steps: "
            "give another seed, or perceptual=none"
        )
    net = SelfFeatures(settings.widths)
    net.features.load_state_dict(without_normalisation(layers.cpu().eval(), settings.widths).state_dict())
    rows = torch.randperm(len(images), generator=generator)[:_CALIBRATION_PICTURES]
    net.to(device)
    net.calibrate_(images[rows].to(device).float() / 255)
    return net


@dataclass(frozen=True)
class ViewPair:
    """Two augmented crops of each picture and where they show the same points.

    Attributes:
        first, second: (N, 3, crop, crop) views, 0..1.
        first_places, second_places: (N, P) flat index into each view's feature map; entry p is one point of
        the picture.
    """

    first: Float[Tensor, "n 3 c c"]
    second: Float[Tensor, "n 3 c c"]
    first_places: Int64[Tensor, "n p"]
    second_places: Int64[Tensor, "n p"]


def two_views(
    pictures: Float[Tensor, "n 3 h w"], crop: int, stride: int, places: int, generator: Generator
) -> ViewPair:
    """Crop each picture twice, mirror both crops alike, augment each by itself.

    Crops lie inside the picture, take at most three quarters of its side, and are up to a quarter of the crop
    apart, by whole strides: feature locations correspond exactly. The first is placed to the pixel.
    """
    n, _, height, width = pictures.shape
    crop = min(crop, 3 * min(height, width) // 4) // stride * stride
    if crop < 2 * stride:
        raise ValueError(
            f"pictures of {height} x {width} are too small to learn features of stride {stride} from"
        )
    cells = crop // stride
    reach = max(1, cells // 4)
    corners = torch.stack(
        [_crop_corners(n, side - crop, stride, reach, generator) for side in (height, width)], dim=2
    )
    first_corner, second_corner = corners
    offset = (second_corner - first_corner) // stride
    lowest = offset.clamp(min=0)
    extent = cells - offset.abs()
    drawn = torch.rand((n, places, 2), generator=generator)
    first_cell = lowest.unsqueeze(1) + (drawn * extent.unsqueeze(1)).long()
    second_cell = first_cell - offset.unsqueeze(1)
    mirrored = torch.rand((n, 1), generator=generator) < 0.5

    def flat(cell: Tensor) -> Tensor:
        column = torch.where(mirrored, cells - 1 - cell[..., 1], cell[..., 1])
        return (cell[..., 0] * cells + column).to(pictures.device)

    def view(corner: Tensor) -> Tensor:
        cut = torch.stack(
            [
                picture[:, y : y + crop, x : x + crop]
                for picture, (y, x) in zip(pictures, corner.tolist(), strict=True)
            ]
        )
        mirror = mirrored.view(-1, 1, 1, 1).to(cut.device)
        return photometric_augmentation(torch.where(mirror, cut.flip(3), cut), generator)

    return ViewPair(view(first_corner), view(second_corner), flat(first_cell), flat(second_cell))


def photometric_augmentation(
    images: Float[Tensor, "n 3 h w"], generator: Generator
) -> Float[Tensor, "n 3 h w"]:
    """Brightness, contrast, a colour cast and noise, drawn for each picture; the result stays in 0..1.

    There is no blur: features that ignore it would not miss the detail that a blurred rendering lacks
    (measured on synface64, relative to another identity's distance: blur of 1 pixel 0.034 without and 0.018
    with it).
    """

    def draw(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator).to(images)

    n = len(images)
    mean = images.mean(dim=(1, 2, 3), keepdim=True)
    contrast = 0.7 + 0.6 * draw(n, 1, 1, 1)
    gain = 0.7 + 0.6 * draw(n, 1, 1, 1)
    cast = 0.9 + 0.2 * draw(n, 3, 1, 1)
    changed = ((images - mean) * contrast + mean) * gain * cast
    noise = torch.randn(images.shape, generator=generator).to(images)
    return (changed + noise * 0.03 * draw(n, 1, 1, 1)).clamp(0, 1)


def _crop_corners(n: int, slack: int, stride: int, reach: int, generator: Generator) -> Int64[Tensor, "2 n"]:
    """First and second corner along one axis: the first uniform, the second whole strides away."""
    first = torch.randint(slack + 1, (n,), generator=generator)
    lowest = -torch.minimum(first // stride, torch.tensor(reach))
    highest = torch.minimum((slack - first) // stride, torch.tensor(reach))
    steps = lowest + (torch.rand(n, generator=generator) * (highest - lowest + 1)).long()
    return torch.stack([first, first + steps * stride])


def _at(codes: Float[Tensor, "n c h w"], places: Int64[Tensor, "n p"]) -> Float[Tensor, "np c"]:
    codes = codes.flatten(2)
    return codes.gather(2, places.unsqueeze(1).expand(-1, codes.shape[1], -1)).transpose(1, 2).flatten(0, 1)


def endless_order(count: int, generator: Generator) -> Iterator[int]:
    """Row numbers, each epoch a new permutation."""
    while True:
        yield from torch.randperm(count, generator=generator).tolist()


def _initialised(settings: SelfTraining, generator: Generator) -> tuple[nn.Sequential, nn.Sequential]:
    """Trunk and projection head, their weights drawn from the generator (He normal)."""
    width = settings.widths[-1]
    head = nn.Sequential(
        nn.Conv2d(width, 2 * width, 1), nn.ReLU(), nn.Conv2d(2 * width, settings.projection, 1)
    )
    layers = trunk(settings.widths, normalised=True)
    for module in [*layers, *head]:
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    return layers, head
