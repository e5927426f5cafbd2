"""Training of the framing network: crops of the training images, drawn at random, are the examples.

An image counts as framed as all training images are, on average. So no label is needed, and an object of any
kind will do. Half of the examples are the model's own photographs in other light (views.py), because light
must not move a crop. What lies beyond the image is its reflection, its border, one colour or another image.
"""

import math

import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Generator, Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, avg_pool2d, gaussian_nll_loss, grid_sample

from derender.data import Progress
from derender.model import Derenderer
from derender.objectives.self_features import without_normalisation
from derender.postprocess.framing import HIDDEN, SIDE, STRIDES, UNIT, WIDTHS, Framing, limited, standardised
from derender.scene.crop import back, crop_images, similarities
from derender.scene.perturb import PerturbSettings
from derender.training.process import evaluating
from derender.training.views import batches, photographs

KEPT = 16_384  # training images that are shown, at most
BATCH, RATE, WARMUP = 128, 2e-3, 200
SPREAD = (0.15, 0.175, 0.11, 0.11)  # deviations of scale's logarithm, roll in radians, place; twice at most
NEAR = 0.3  # of the spread, for half of the crops: the network looks again at its first answer
SHOWN_BEYOND = (0.92, 0.6, 0.35)  # shares of images, the last first: another, border, reflection; a colour
UNTURNED = PerturbSettings(camera_pitch_deg=0, camera_yaw_deg=0)


@torch.enable_grad()
def fit_framing(
    model: Derenderer, images: Shaped[Tensor, "n 3 h w"], crops: int, *, seed: int = 0,
    progress: Progress | None = None,
) -> Framing:  # fmt: skip
    """The framing network of a model's training images, uint8 or float in 0..1, after so many crops."""
    model, generator = model.without_features().with_brightness(None), Generator().manual_seed(seed)
    kept = torch.randperm(len(images), generator=generator)[:KEPT]
    plain, lit = _examples(model, images, kept, generator)
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        network = _network().to(model.device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=1e-3)
    steps = math.ceil(crops / BATCH)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / WARMUP) * (1 + math.cos(math.pi * step / steps)) / 2
        rows = torch.randint(len(kept), (BATCH,), generator=generator)
        shown, wanted = drawn_crops(plain[rows], lit[rows], generator)
        shown, wanted = shown.to(model.device), wanted.to(model.device)
        answer, error = network(standardised(shown)).chunk(2, dim=1)
        loss = gaussian_nll_loss(answer, wanted / UNIT, (2 * limited(error)).exp())
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        if progress is not None:
            progress(min((step + 1) * BATCH, crops), crops)
    layers = [layer.state_dict() for layer in without_normalisation(network.eval()) if layer.state_dict()]
    named = ((f"{name}{place}", value) for place, state in enumerate(layers) for name, value in state.items())
    return Framing({name: value.cpu() for name, value in named})


def _examples(
    model: Derenderer, images: Shaped[Tensor, "n 3 h w"], rows: Tensor, generator: Generator
) -> tuple[UInt8[Tensor, "k 3 64 64"], UInt8[Tensor, "k 3 64 64"]]:
    """The images, and one photograph of each in other light; themselves where the model knows no light."""
    parts: list[list[Tensor]] = [[], []]
    with evaluating(model), torch.no_grad():
        for _, batch in batches(model, images, rows, None):
            scene, pair = model.decompose(batch), [batch, batch]
            if {"albedo", "depth", "light", "camera"} <= scene.parameters.keys():
                pair = photographs(model, scene, batch, generator, 1, UNTURNED)
            for part, shown in zip(parts, pair, strict=True):
                part.append((255 * adaptive_avg_pool2d(shown, SIDE)).round().byte().cpu())
    return torch.cat(parts[0]), torch.cat(parts[1])


def drawn_crops(
    plain: UInt8[Tensor, "n 3 s s"], lit: UInt8[Tensor, "n 3 s s"], generator: Generator
) -> tuple[Float[Tensor, "n 3 s s"], Float[Tensor, "n 4"]]:
    """A random crop of each image or of its photograph, and the parameters of the crop that undoes it."""
    count = len(plain)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator).clamp(-2, 2)

    wanted = normal(4) * torch.tensor(SPREAD)
    wanted = torch.where(uniform(1) < 0.5, wanted, NEAR * wanted)
    tone = (0.3 * normal(1, 1, 1)).exp() * plain.float() / 255
    tone = torch.where(uniform(1, 1, 1) < 0.3, tone.mean(dim=1, keepdim=True), tone)
    tone = tone.clamp(1e-4, 1) ** (0.2 * normal(1, 1, 1)).exp()
    images = torch.where(uniform(1, 1, 1) < 0.5, lit.float() / 255, tone)
    images = torch.where(uniform(1, 1, 1) < 0.5, images.flip(-1), images)
    others = crop_images(tone.roll(1, 0), similarities(normal(4) * torch.tensor([0.4, 1.5, 0.4, 0.4])))
    crops = back(similarities(wanted))
    grid = affine_grid(crops, list(images.shape), align_corners=False)
    bordered = grid_sample(images, grid, padding_mode="border", align_corners=False)
    which, reflected = uniform(1, 1, 1), crop_images(images, crops)
    beyond = uniform(3, 1, 1).expand_as(images)
    for share, one in zip(SHOWN_BEYOND, (reflected, bordered, others), strict=True):
        beyond = torch.where(which < share, one, beyond)
    shown = torch.where((grid.abs() > 1).any(dim=-1)[:, None], beyond, reflected)
    soft = avg_pool2d(shown, 3, stride=1, padding=1, count_include_pad=False)
    shown = torch.where(uniform(1, 1, 1) < 0.3, soft, shown)
    noise = torch.randn(shown.shape, generator=generator)
    return (shown + 0.03 * uniform(1, 1, 1) * noise).clamp(0, 1), wanted


def _network() -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after, stride in zip((3, *WIDTHS), WIDTHS, STRIDES, strict=False):
        layers += [nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
    cells = (SIDE // math.prod(STRIDES)) ** 2
    ends = nn.Linear(WIDTHS[-1] * cells, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 8)
    return nn.Sequential(*layers, nn.Flatten(), *ends)
