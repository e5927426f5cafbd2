"""Autoencoders of our geometry net's size: the effect of the bottleneck alone, without any physics.

Plain: the encoder and the map decoder of networks/ with three output channels, 12,982,848 parameters (our
albedo net), least squares. beta-VAE: the same with a normal posterior over the code; source Higgins et al.,
*beta-VAE* (ICLR 2017), Bernoulli likelihood as there, divided by the number of colour values in an image so
that both terms have one scale. Leaves out sampling of new images.
"""

from typing import Any, Literal

import torch
from jaxtyping import Float
from pydantic import Field, field_validator
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss

from derender.baselines.model import BaselineModel, BaselineSettings, Images, LossInputs
from derender.networks.decoders import MapDecoder
from derender.networks.encoders import Encoder, NetworkSettings
from derender.settings import Settings
from derender.training.config import LoopSettings, OptimiserSettings


class AutoencoderSettings(BaselineSettings):
    """Sizes as in `NetworkSettings`; the defaults are the geometry net's."""

    width: int = Field(default=64, ge=4, multiple_of=4)
    code_size: int = Field(default=256, ge=1)

    @field_validator("image_size")
    @classmethod
    def _as_ours(cls, value: int) -> int:
        return NetworkSettings(image_size=value).image_size

    def encoder(self, code_size: int | None = None) -> Encoder:
        """A geometry encoder of this size."""
        return Encoder(self.network, self.width, code_size or self.code_size, normalised=True)

    @property
    def network(self) -> NetworkSettings:
        """The same sizes as our own networks take them."""
        return NetworkSettings(image_size=self.image_size, width=self.width, code_size=self.code_size)


class AutoencoderConfig(LoopSettings):
    """One training run of a plain autoencoder."""

    baseline: Literal["ae"] = "ae"
    model: AutoencoderSettings = AutoencoderSettings()
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=1e-3, weight_decay=0.0)


class BetaObjective(Settings):
    """The weight of the divergence from the prior; 1 is an ordinary VAE."""

    beta: float = Field(default=4.0, ge=0)


class BetaVaeConfig(LoopSettings):
    """One training run of a beta-VAE."""

    baseline: Literal["beta-vae"] = "beta-vae"
    model: AutoencoderSettings = AutoencoderSettings()
    objective: BetaObjective = BetaObjective()
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=1e-3, weight_decay=0.0)


class Autoencoder(BaselineModel):
    """Image to code to image. Feature: ``code``, as our own codes the output of a ReLU."""

    name, settings_type, config_type = "ae", AutoencoderSettings, AutoencoderConfig
    features = ("code",)
    settings: AutoencoderSettings

    def __init__(self, settings: AutoencoderSettings):
        super().__init__(settings)
        self.encoder = settings.encoder()
        self.decoder = MapDecoder(settings.network, 3)

    def reconstruct(self, images: Images) -> Images:
        """Images through the code, in 0..1."""
        return self.decoder(self.encoder(images)).float().tanh() / 2 + 0.5

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        return {"code": self.encoder(images)}

    def shown(self, images: Images, config: Any) -> dict[str, Images]:
        return {"input": images, "reconstruction": self.reconstruct(images)}

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Mean squared error in 0..1, and beside it L1."""
        with run.precision():
            again = self.reconstruct(images)
        return {"reconstruction": mse_loss(again, images), "l1": (again.detach() - images).abs().mean()}


class BetaVae(BaselineModel):
    """Image to a normal posterior over codes to an image. Feature: ``mean``, the posterior's mean."""

    name, settings_type, config_type = "beta-vae", AutoencoderSettings, BetaVaeConfig
    features = ("mean",)
    settings: AutoencoderSettings

    def __init__(self, settings: AutoencoderSettings):
        super().__init__(settings)
        self.encoder = settings.encoder(2 * settings.code_size)
        self.encoder.to_code = nn.Sequential(self.encoder.to_code[0])  # no ReLU: a mean has both signs
        self.decoder = MapDecoder(settings.network, 3)

    def posterior(self, images: Images) -> tuple[Float[Tensor, "n code"], Float[Tensor, "n code"]]:
        """Mean and log variance of every number of the code."""
        mean, log_variance = self.encoder(images).float().chunk(2, dim=1)
        return mean, log_variance.clamp(-20, 10)

    def logits(self, code: Float[Tensor, "n code"]) -> Images:
        """Log odds of every colour value."""
        return self.decoder(code).float()

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        return {"mean": self.posterior(images)[0]}

    def shown(self, images: Images, config: Any) -> dict[str, Images]:
        return {"input": images, "reconstruction": self.logits(self.posterior(images)[0]).sigmoid()}

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Bernoulli likelihood and weighted divergence, both per colour value; beside them L1, ``active``.

        ``active`` counts the numbers of the code whose divergence, averaged over the batch, is above 0.01
        nats. The code is sampled in training and is the mean otherwise.
        """
        with run.precision():
            mean, log_variance = self.posterior(images)
        code = mean
        if self.training:
            noise = torch.randn(mean.shape, generator=run.generator).to(mean)
            code = mean + noise * (0.5 * log_variance).exp()
        with run.precision():
            logits = self.logits(code)
        divergence = kl_to_standard_normal(mean, log_variance)
        return {
            "reconstruction": binary_cross_entropy_with_logits(logits, images),
            "kl": run.config.objective.beta * divergence.sum(dim=1).mean() / images[0].numel(),
            "l1": (logits.detach().sigmoid() - images).abs().mean(),
            "active": (divergence.detach().mean(dim=0) > 0.01).float().sum(),
        }


def kl_to_standard_normal(
    mean: Float[Tensor, "n code"], log_variance: Float[Tensor, "n code"]
) -> Float[Tensor, "n code"]:
    """Divergence of N(mean, variance) from N(0, 1) in nats, number by number; at least 0."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance)
