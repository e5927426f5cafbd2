"""How a StyleGAN2 learns: two networks against each other, both moved in every step.

Source: Karras et al. (CVPR 2020): non-saturating logistic loss; R1 on real pictures every 16th step and path
lengths every 4th, both weighted by their interval; style mixing; the generator that is used is a moving
average, its half-life 10,000 pictures and never more than a twentieth of what was seen (as in *Training GANs
with Limited Data*, 2020). Both networks look at one batch of fakes and move in the same step, with one
optimiser, so that the common training loop fits. Held-out pictures are judged by the energy distance between
them and samples. Leaves out augmentation of the discriminator.
"""

from copy import deepcopy
from math import sqrt
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Generator as RandomGenerator
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import adaptive_avg_pool2d, softplus

from derender.baselines.model import BaselineModel
from derender.baselines.stylegan2.discriminator import Discriminator
from derender.baselines.stylegan2.generator import Generator, GeneratorSettings, truncate
from derender.settings import Settings
from derender.training.batches import random_stream
from derender.training.config import LoopSettings, OptimiserSettings
from derender.training.step import Precision

ADVERSARIAL_TERMS = ("generator", "discriminator", "r1", "path")
"""Parts of the training loss, which say nothing of held-out pictures."""
JUDGED_SIDE = 16  # held-out pictures and samples are compared at most this large
CENTRE_LATENTS = 4_096
R1_PER_PIXEL = 2e-4
SHOWN = 6


class AdversarialObjective(Settings):
    """Weights and intervals of the regularisers, style mixing, and the moving average."""

    r1_weight: float | None = Field(default=None, ge=0)  # None: by size and batch, see ``r1_weight_of``
    r1_every: int = Field(default=16, ge=1)
    path_weight: float = Field(default=2.0, ge=0)
    path_every: int = Field(default=4, ge=1)
    path_decay: float = Field(default=0.01, gt=0, le=1)
    mixing: float = Field(default=0.9, ge=0, le=1)  # share of pictures made from two latents
    average_images: int = Field(default=10_000, ge=1)  # half-life of the moving average


class StyleganConfig(LoopSettings):
    """One training run of a StyleGAN2."""

    baseline: Literal["stylegan2"] = "stylegan2"
    model: GeneratorSettings = GeneratorSettings()
    objective: AdversarialObjective = AdversarialObjective()
    batch_size: int = Field(default=32, ge=2)
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=2e-3, weight_decay=0.0, betas=(0.0, 0.99))
    patience: int = Field(default=1_000, ge=1)
    channels_last: bool = False


class Stylegan(BaselineModel):
    """Generator, its moving average, and discriminator. Feature: the discriminator's last hidden layer."""

    name = "stylegan2"
    features = ("discriminator",)
    settings: GeneratorSettings
    steps: Tensor
    path_length: Tensor

    def __init__(self, settings: GeneratorSettings):
        super().__init__(settings)
        self.learner = Generator(settings)
        self.generator = deepcopy(self.learner).requires_grad_(False)
        self.discriminator = Discriminator(settings)
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))
        self.register_buffer("path_length", torch.zeros(()))

    def describe(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        return {"discriminator": self.discriminator.describe(2 * images - 1)}

    @torch.no_grad()
    def sample(
        self, count: int, generator: RandomGenerator, *, truncation: float = 1.0
    ) -> Float[Tensor, "n 3 h w"]:
        """New pictures in 0..1, by the moving average."""
        net = self.generator
        w = net.mapping(net.random_z(count, generator))
        if truncation != 1:
            w = truncate(w, net.mean_w(CENTRE_LATENTS, generator), truncation)
        return (net(w, net.random_noise(count, generator)) / 2 + 0.5).clamp(0, 1)

    def shown(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n 3 h w"]]:
        samples = self.sample(SHOWN * len(images), random_stream(0, "perturb", 0)).chunk(SHOWN)
        return {"real": images, **{f"sample {n}": column for n, column in enumerate(samples, 1)}}

    @torch.no_grad()
    def average(self, batch: int, half_life: int) -> None:
        """Count a step, and move the averaged generator towards the learner as it is now."""
        self.steps += 1
        span = min(half_life, max(int(self.steps) * batch // 20, 1))
        keep = 0.5 ** (batch / span)
        learnt = self.learner.state_dict()
        for name, value in self.generator.state_dict().items():
            value.lerp_(learnt[name], 1 - keep)


def adversarial_losses(
    model: Stylegan,
    images: Float[Tensor, "n 3 h w"],
    objective: AdversarialObjective,
    generator: RandomGenerator,
    precision: Precision,
) -> dict[str, Tensor]:
    """Losses of both networks, each blind to the other's weights; of held-out pictures the energy distance.

    Logistic losses are about 0.69 each at chance. In steps with a regulariser it is there, weighted.
    """
    if not model.training:
        samples = model.sample(len(images), generator)
        return {"energy": energy_distance(_for_judging(images), _for_judging(samples))}
    n, net = len(images), model.learner
    model.average(n, objective.average_images)
    step = int(model.steps) - 1
    real = 2 * images - 1
    with precision():
        w_plus = mixed_w(net, n, objective.mixing, generator)
        fake = net(w_plus, net.random_noise(n, generator))
        frozen = {name: value.detach() for name, value in model.discriminator.named_parameters()}
        terms = {
            "generator": softplus(-functional_call(model.discriminator, frozen, (fake,))).float().mean(),
            "discriminator": softplus(model.discriminator(fake.detach())).float().mean()
            + softplus(-model.discriminator(real)).float().mean(),
        }
    r1_weight = r1_weight_of(objective, real.shape[-1], n)
    if r1_weight and step % objective.r1_every == 0:
        terms["r1"] = r1_weight * objective.r1_every * r1_penalty(model.discriminator, real)
    if objective.path_weight and step % objective.path_every == 0:
        penalty = path_penalty(model, max(n // 2, 1), objective, generator)
        terms["path"] = objective.path_weight * objective.path_every * penalty
    return terms


def r1_weight_of(objective: AdversarialObjective, side: int, batch: int) -> float:
    """The weight of R1 that was asked for, or 2e-4 for each pixel of a picture over the pictures of a batch.

    So in *Training GANs with Limited Data* (2020): 6.6 at 1024 pixels and 0.026 at 64, in batches of 32. A
    gradient is summed over pixels: what suits large pictures blinds the discriminator to small ones.
    """
    given = objective.r1_weight
    return R1_PER_PIXEL * side**2 / batch if given is None else given


def mixed_w(
    net: Generator, count: int, mixing: float, generator: RandomGenerator
) -> Float[Tensor, "n codes d"]:
    """W+ of random latents; a share ``mixing`` of them changes to a second latent at a random layer."""
    first, second = net.w_plus(net.mapping(net.random_z(2 * count, generator))).chunk(2)
    codes = net.settings.codes
    place = torch.randint(1, codes, (count,), generator=generator)
    mixed = torch.rand(count, generator=generator) < mixing
    place = torch.where(mixed, place, codes).to(first.device)
    later = torch.arange(codes, device=first.device) >= place[:, None]
    return torch.where(later[:, :, None], second, first)


def r1_penalty(discriminator: nn.Module, real: Float[Tensor, "n 3 h w"]) -> Float[Tensor, ""]:
    """Half the mean squared norm of the score's gradient with respect to real pictures; 0 is flat."""
    real = real.detach().requires_grad_(True)
    (gradient,) = torch.autograd.grad(discriminator(real).sum(), real, create_graph=True)
    return gradient.square().sum(dim=(1, 2, 3)).mean() / 2


def path_lengths(
    net: Generator, w_plus: Float[Tensor, "n codes d"], generator: RandomGenerator
) -> Float[Tensor, " n"]:
    """How far a picture moves, in a random direction, for a unit step of W+: |J^T y| over the codes' mean."""
    if not w_plus.requires_grad:
        w_plus = w_plus.requires_grad_(True)
    fake = net(w_plus, net.random_noise(len(w_plus), generator))
    direction = torch.randn(fake.shape, generator=generator).to(fake) / sqrt(fake[0, 0].numel())
    (gradient,) = torch.autograd.grad((fake * direction).sum(), w_plus, create_graph=True)
    return gradient.square().sum(dim=2).mean(dim=1).sqrt()


def path_penalty(
    model: Stylegan, count: int, objective: AdversarialObjective, generator: RandomGenerator
) -> Float[Tensor, ""]:
    """Mean squared difference of path lengths from their moving mean, which it moves; 0 is best."""
    w_plus = mixed_w(model.learner, count, objective.mixing, generator)
    lengths = path_lengths(model.learner, w_plus, generator)
    with torch.no_grad():
        model.path_length.lerp_(lengths.mean(), objective.path_decay)
    return (lengths - model.path_length).square().mean()


def energy_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
    """Unbiased energy distance over sqrt(d); about 0 for two draws of one distribution, larger is worse."""
    if min(len(first), len(second)) < 2:
        return torch.zeros((), device=first.device)

    def within(rows: Tensor) -> Tensor:
        return torch.cdist(rows, rows).sum() / (len(rows) * (len(rows) - 1))

    between = torch.cdist(first, second).mean()
    return (2 * between - within(first) - within(second)) / sqrt(first.shape[1])


def _for_judging(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n d"]:
    side = min(JUDGED_SIDE, images.shape[-1])
    return adaptive_avg_pool2d(images.float(), side).flatten(1)
