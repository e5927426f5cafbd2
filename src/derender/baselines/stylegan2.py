"""StyleGAN2 as a baseline: its discriminator, and how it and the generator learn against each other.

Source: Karras et al. (CVPR 2020): non-saturating logistic loss; R1 and path lengths in every 16th and 4th
step, weighted by their interval; style mixing. The generator that samples is a moving average (*Training GANs
with Limited Data*, 2020). Its half-life is 10,000 images and at most a twentieth of those seen. The map of
group deviations: *Progressive Growing of GANs* (ICLR 2018). Both networks see one batch of fakes and move in
the same step, with one optimiser, so that the common training loop fits. Held-out images are judged by the
energy distance between them and samples. Leaves out augmentation of the discriminator's input.
"""

from copy import deepcopy
from itertools import pairwise
from math import sqrt
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Generator as RandomGenerator
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import adaptive_avg_pool2d, softplus

from derender.baselines import generator as gan
from derender.baselines.model import Features, Images, LoopModel, LossInputs
from derender.settings import Settings
from derender.training.batches import random_stream
from derender.training.config import LoopSettings, OptimiserSettings

GROUP = 4
JUDGED_SIDE = 16  # held-out images and samples are compared at most this large
CENTRE_LATENTS = 4_096
R1_PER_PIXEL = 2e-4  # times pixels over batch: a gradient is summed over pixels
SHOWN = 6


class AdversarialObjective(Settings):
    """Weights and intervals of the regularisers, style mixing, and the moving average."""

    r1_weight: float | None = Field(default=None, ge=0)  # None: as R1_PER_PIXEL says
    r1_every: int = Field(default=16, ge=1)
    path_weight: float = Field(default=2.0, ge=0)
    path_every: int = Field(default=4, ge=1)
    path_decay: float = Field(default=0.01, gt=0, le=1)
    mixing: float = Field(default=0.9, ge=0, le=1)  # share of images made from two latents
    average_images: int = Field(default=10_000, ge=1)  # half-life of the moving average


class StyleganConfig(LoopSettings):
    """One training run of a StyleGAN2."""

    baseline: Literal["stylegan2"] = "stylegan2"
    model: gan.GeneratorSettings = gan.GeneratorSettings()
    objective: AdversarialObjective = AdversarialObjective()
    batch_size: int = Field(default=32, ge=2)
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=2e-3, weight_decay=0.0, betas=(0.0, 0.99))
    patience: int = Field(default=1_000, ge=1)
    channels_last: bool = False


class ResidualDown(nn.Module):
    """Two convolutions and a skip to half the size; the sum is divided by sqrt 2."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first = gan.EqualConv(inputs, inputs, 3)
        self.second = gan.EqualConv(inputs, outputs, 3, down=True)
        self.skip = gan.EqualConv(inputs, outputs, 1, down=True, active=False)

    def forward(self, images: gan.Maps) -> gan.Maps:
        return (self.second(self.first(images)) + self.skip(images)) / sqrt(2)


class Discriminator(nn.Module):
    """Image in -1..1 to one number: high is real. ``describe`` gives the input of the last layer."""

    def __init__(self, settings: gan.GeneratorSettings):
        super().__init__()
        widths = [settings.channels(size) for size in settings.resolutions[::-1]]
        last = widths[-1]
        self.from_rgb = gan.EqualConv(3, widths[0], 1)
        self.blocks = nn.Sequential(*(ResidualDown(whole, half) for whole, half in pairwise(widths)))
        self.last_conv = gan.EqualConv(last + 1, last, 3)
        self.hidden = gan.EqualLinear(16 * last, last, active=True)
        self.score = gan.EqualLinear(last, 1)

    def describe(self, images: Images, *, group: int = 1) -> Float[Tensor, "n d"]:
        """The last hidden layer. With ``group`` 1 no image affects another's.

        One map more is the mean standard deviation over the group: the images equal modulo n / ``group``.
        """
        maps = self.blocks(self.from_rgb(images))
        variance = maps.reshape(group, len(maps) // group, -1).var(dim=0, unbiased=False)
        extra = (variance + gan.TINY).sqrt().mean(dim=1).repeat(group)[:, None, None, None]
        maps = torch.cat([maps, extra.expand(-1, 1, *maps.shape[2:])], dim=1)
        return self.hidden(self.last_conv(maps).flatten(1))

    def forward(self, images: Images) -> Float[Tensor, " n"]:
        """Scores, log odds of being real; groups of at most 4 that divide the batch are compared."""
        group = next(size for size in range(GROUP, 0, -1) if len(images) % size == 0)
        return self.score(self.describe(images, group=group))[:, 0]


class Stylegan(LoopModel):
    """Generator, its moving average, and discriminator. Feature: the discriminator's last hidden layer."""

    name, settings_type, config_type = "stylegan2", gan.GeneratorSettings, StyleganConfig
    features = ("discriminator",)
    given_as = ", for e4e as --set generator=RUN"
    not_judged = ("generator", "discriminator", "r1", "path")
    settings: gan.GeneratorSettings
    steps: Tensor
    path_length: Tensor

    def __init__(self, settings: gan.GeneratorSettings):
        super().__init__(settings)
        self.learner = gan.Generator(settings)
        self.generator = deepcopy(self.learner).requires_grad_(False)
        self.discriminator = Discriminator(settings)
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))
        self.register_buffer("path_length", torch.zeros(()))

    def describe(self, images: Images) -> Features:
        return {"discriminator": self.discriminator.describe(2 * images - 1)}

    @torch.no_grad()
    def sample(self, count: int, generator: RandomGenerator) -> Images:
        """New images in 0..1, by the moving average."""
        net = self.generator
        made = net(net.random_w(count, generator), net.random_noise(count, generator))
        return (made / 2 + 0.5).clamp(0, 1)

    def shown(self, images: Images) -> dict[str, Images]:
        samples = self.sample(SHOWN * len(images), random_stream(0, "perturb", 0)).chunk(SHOWN)
        return {"real": images, **{f"sample {n}": column for n, column in enumerate(samples, 1)}}

    @torch.no_grad()
    def average(self, batch: int, half_life: int) -> None:
        """Count a step, and move the averaged generator towards the learner as it is now."""
        self.steps += 1
        span = min(half_life, max(int(self.steps) * batch // 20, 1))
        learnt = self.learner.state_dict()
        for name, value in self.generator.state_dict().items():
            value.lerp_(learnt[name], 1 - 0.5 ** (batch / span))

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Losses of both networks, each blind to the other's weights; of held-out images the energy distance.

        Logistic losses are about 0.69 each at chance. Regularisers are in the steps of their interval,
        weighted.
        """
        if not self.training:
            small = min(JUDGED_SIDE, images.shape[-1])
            both = images.float(), self.sample(len(images), run.generator)
            return {"energy": energy_distance(*(adaptive_avg_pool2d(one, small).flatten(1) for one in both))}
        n, net, judge, objective = len(images), self.learner, self.discriminator, run.config.objective
        self.average(n, objective.average_images)
        step, real = int(self.steps) - 1, 2 * images - 1
        with run.precision():
            w_plus = mixed_w(net, n, objective.mixing, run.generator)
            fake = net(w_plus, net.random_noise(n, run.generator))
            frozen = {name: value.detach() for name, value in judge.named_parameters()}
            terms = {
                "generator": softplus(-functional_call(judge, frozen, (fake,))).float().mean(),
                "discriminator": softplus(judge(fake.detach())).float().mean()
                + softplus(-judge(real)).float().mean(),
            }
        usual = R1_PER_PIXEL * real.shape[-1] ** 2 / n
        r1_weight = usual if objective.r1_weight is None else objective.r1_weight
        if r1_weight and step % objective.r1_every == 0:
            terms["r1"] = r1_weight * objective.r1_every * r1_penalty(judge, real)
        if objective.path_weight and step % objective.path_every == 0:
            half = mixed_w(net, max(n // 2, 1), objective.mixing, run.generator)
            lengths = path_lengths(net, half, run.generator)
            self.path_length.lerp_(lengths.detach().mean(), objective.path_decay)
            penalty = (lengths - self.path_length).square().mean()
            terms["path"] = objective.path_weight * objective.path_every * penalty
        return terms


def mixed_w(net: gan.Generator, count: int, mixing: float, generator: RandomGenerator) -> gan.Codes:
    """W+ of random latents; a share ``mixing`` of them changes to a second latent at a random layer."""
    first, second = net.w_plus(net.random_w(2 * count, generator)).chunk(2)
    codes = net.settings.codes
    place = torch.randint(1, codes, (count,), generator=generator)
    mixed = torch.rand(count, generator=generator) < mixing
    later = torch.arange(codes) >= torch.where(mixed, place, codes)[:, None]
    return torch.where(later[:, :, None].to(first.device), second, first)


def r1_penalty(discriminator: nn.Module, real: Images) -> Float[Tensor, ""]:
    """Half the mean squared norm of the score's gradient with respect to real images; 0 is flat."""
    real = real.detach().requires_grad_(True)
    (gradient,) = torch.autograd.grad(discriminator(real).sum(), real, create_graph=True)
    return gradient.square().sum(dim=(1, 2, 3)).mean() / 2


def path_lengths(net: gan.Generator, w_plus: gan.Codes, generator: RandomGenerator) -> Float[Tensor, " n"]:
    """How far an image moves, in a random direction, for a unit step of W+: |J^T y| over the codes' mean."""
    fake = net(w_plus.requires_grad_(), net.random_noise(len(w_plus), generator))
    direction = torch.randn(fake.shape, generator=generator).to(fake) / sqrt(fake[0, 0].numel())
    (gradient,) = torch.autograd.grad((fake * direction).sum(), w_plus, create_graph=True)
    return gradient.square().sum(dim=2).mean(dim=1).sqrt()


def energy_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
    """Unbiased energy distance over sqrt(d); about 0 for two samples of one distribution, larger is worse."""
    if min(len(first), len(second)) < 2:
        return torch.zeros((), device=first.device)
    within = [torch.cdist(rows, rows).sum() / (len(rows) * (len(rows) - 1)) for rows in (first, second)]
    return (2 * torch.cdist(first, second).mean() - within[0] - within[1]) / sqrt(first.shape[1])
