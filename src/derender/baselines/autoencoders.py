"""Autoencoders: plain, beta-VAE and VQ-VAE; each makes a code and an image again, without any physics.

Plain: encoder and map decoder of our albedo net, 12,982,848 parameters, least squares. beta-VAE (Higgins et
al., ICLR 2017): the same with a normal posterior over the code. Its Bernoulli likelihood is divided by the
number of colour values, so that both terms have one scale. VQ-VAE: source van den Oord et al., *Neural
Discrete Representation Learning* (2017), in the size that the paper compares with, by its two readings:
19,199,491 parameters are those of 512 channels, 416 have 12,724,195 (``width``), both with eight BatchNorms,
whose places it does not tell. The codebook, of vector-quantize-pytorch (MIT), is learnt by gradient as in the
source, from k-means on the first batch. Entries that hardly any place chose are replaced by places of the
batch.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from jaxtyping import Float, Int64
from pydantic import Field, field_validator
from torch import Generator, Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss, one_hot

from derender.baselines import model as base
from derender.networks.decoders import MapDecoder
from derender.networks.encoders import Encoder, NetworkSettings
from derender.settings import Settings
from derender.storage.places import optional

Grid = Float[Tensor, "n d gh gw"]  # one vector for each of the places of a grid


class AutoencoderSettings(base.BaselineSettings):
    """Sizes as in `NetworkSettings`; the defaults are the geometry net's."""

    width: int = Field(default=64, ge=4, multiple_of=4)
    code_size: int = Field(default=256, ge=1)

    @field_validator("image_size")
    @classmethod
    def _as_ours(cls, value: int) -> int:
        return NetworkSettings(image_size=value).image_size

    def encoder(self, codes: int = 1) -> Encoder:
        """A geometry encoder of this size, of one code or more side by side."""
        return Encoder(self.network, self.width, codes * self.code_size, normalised=True)

    @property
    def network(self) -> NetworkSettings:
        """The same sizes as our own networks take them."""
        return NetworkSettings(image_size=self.image_size, width=self.width, code_size=self.code_size)


class AutoencoderConfig(base.BaselineConfig):
    """One training run of a plain autoencoder."""

    baseline: Literal["ae"] = "ae"
    model: AutoencoderSettings = AutoencoderSettings()


class Autoencoder(base.LoopModel):
    """Image to code to image. Feature: ``code``, as our own codes the output of a ReLU."""

    name, settings_type, config_type = "ae", AutoencoderSettings, AutoencoderConfig
    features = ("code",)
    settings: AutoencoderSettings
    codes = 1

    def __init__(self, settings: AutoencoderSettings):
        super().__init__(settings)
        self.encoder = settings.encoder(self.codes)
        self.decoder = MapDecoder(settings.network, 3)

    def reconstruct(self, images: base.Images) -> base.Images:
        return self.decoder(self.encoder(images)).float().tanh() / 2 + 0.5

    def describe(self, images: base.Images) -> base.Features:
        return {"code": self.encoder(images)}

    def losses(self, images: base.Images, run: base.LossInputs) -> dict[str, Tensor]:
        """Mean squared error in 0..1, and beside it L1."""
        with run.precision():
            again = self.reconstruct(images)
        return {"reconstruction": mse_loss(again, images), "l1": (again.detach() - images).abs().mean()}


class BetaObjective(Settings):
    """The weight of the divergence from the prior; 1 is an ordinary VAE."""

    beta: float = Field(default=4.0, ge=0)


class BetaVaeConfig(AutoencoderConfig):
    """One training run of a beta-VAE."""

    baseline: Literal["beta-vae"] = "beta-vae"  # pyrefly: ignore[bad-override]
    objective: BetaObjective = BetaObjective()


class BetaVae(Autoencoder):
    """Image to a normal posterior over codes to an image. Feature: ``mean``, the posterior's mean."""

    name, config_type = "beta-vae", BetaVaeConfig
    features = ("mean",)
    codes = 2  # mean and log variance

    def __init__(self, settings: AutoencoderSettings):
        super().__init__(settings)
        self.encoder.to_code = nn.Sequential(self.encoder.to_code[0])  # no ReLU: a mean has both signs

    def posterior(self, images: base.Images) -> tuple[Float[Tensor, "n code"], Float[Tensor, "n code"]]:
        """Mean and log variance of every number of the code."""
        mean, log_variance = self.encoder(images).float().chunk(2, dim=1)
        return mean, log_variance.clamp(-20, 10)

    def describe(self, images: base.Images) -> base.Features:
        return {"mean": self.posterior(images)[0]}

    def reconstruct(self, images: base.Images) -> base.Images:
        return self.decoder(self.posterior(images)[0]).float().sigmoid()

    def losses(self, images: base.Images, run: base.LossInputs) -> dict[str, Tensor]:
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
            logits = self.decoder(code).float()  # log odds of every colour value
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance)  # from N(0, 1), in nats
        return {
            "reconstruction": binary_cross_entropy_with_logits(logits, images),
            "kl": run.config.objective.beta * divergence.sum(dim=1).mean() / images[0].numel(),
            "l1": (logits.detach().sigmoid() - images).abs().mean(),
            "active": (divergence.detach().mean(dim=0) > 0.01).float().sum(),
        }


class VqvaeSettings(base.BaselineSettings):
    """Sizes: channels (D) and entries of the codebook (K). Images are any multiple of 4 pixels wide."""

    image_size: int = Field(default=64, ge=8, multiple_of=4)
    width: int = Field(default=512, ge=1)
    codes: int = Field(default=512, ge=2)
    dead_below: float = Field(default=1.0, ge=0)  # places a batch, averaged; 0: entries are never replaced


class VqvaeObjective(Settings):
    """Weight of the commitment term; the source finds 0.1 to 2 to do alike."""

    commitment: float = Field(default=0.25, ge=0)


class VqvaeConfig(base.BaselineConfig):
    """One training run of a VQ-VAE; the learning rate is that of the paper's text."""

    baseline: Literal["vqvae"] = "vqvae"
    model: VqvaeSettings = VqvaeSettings()
    objective: VqvaeObjective = VqvaeObjective()


class Vqvae(base.LoopModel):
    """Encoder, codebook, decoder.

    Features: ``pooled`` (D numbers: the mean entry over all places), ``map`` (the entries of all places,
    flattened: what the paper compares with, 106,496 numbers at 64x64 and 416 channels; its 416x25x25 are
    those of 100x100 images), ``histogram`` (K numbers: the share of places at each entry).
    """

    name, settings_type, config_type = "vqvae", VqvaeSettings, VqvaeConfig
    features = ("pooled", "map", "histogram")
    not_judged = ("codebook", "commitment")
    settings: VqvaeSettings

    def __init__(self, settings: VqvaeSettings):
        super().__init__(settings)
        width = settings.width
        halves = (4, 2, 1)  # kernel, stride, padding
        self.encoder = nn.Sequential(
            *(nn.Conv2d(3, width, *halves), nn.BatchNorm2d(width), nn.ReLU()),
            *(nn.Conv2d(width, width, *halves), nn.BatchNorm2d(width), nn.ReLU()),
            *(Residual(width, normalised=True), nn.BatchNorm2d(width)),
            *(Residual(width, normalised=True), nn.BatchNorm2d(width)),
        )
        self.codebook = optional("vector_quantize_pytorch", "the baseline vqvae").VectorQuantize(
            dim=width, codebook_size=settings.codes, accept_image_fmap=True, learnable_codebook=True,
            ema_update=False, rotation_trick=False, kmeans_init=True, commitment_weight=0.0,
            threshold_ema_dead_code=settings.dead_below,
        )  # fmt: skip
        self.decoder = nn.Sequential(
            *(Residual(width, normalised=False), nn.BatchNorm2d(width), Residual(width, normalised=False)),
            *(nn.ConvTranspose2d(width, width, *halves), nn.BatchNorm2d(width), nn.ReLU()),
            nn.ConvTranspose2d(width, 3, *halves),
        )

    def encode(self, images: base.Images) -> Grid:
        """Images in 0..1 to a grid of a quarter of their side, not yet quantised."""
        return self.encoder(images * 2 - 1)

    def quantise(self, grid: Grid) -> tuple[Grid, Grid, Int64[Tensor, "n gh gw"]]:
        """The nearest entry for every place, and its number.

        Gradients of the first pass straight through to the input, those of the second reach the codebook.
        """
        through, indices, _ = self.codebook(grid.float(), freeze_codebook=True)
        return through, self.codebook.get_codes_from_indices(indices), indices

    def decode(self, grid: Grid) -> base.Images:
        """Images, about 0..1 but not clipped."""
        return self.decoder(grid).float() / 2 + 0.5

    def describe(self, images: base.Images) -> base.Features:
        grid = self.encode(images).float()
        _, entries, indices = self.quantise(grid)
        entries = entries + (grid - grid.detach())  # fine-tuning reaches the encoder, values stay the entries
        chosen = indices.flatten(1)
        share = torch.zeros(len(chosen), self.settings.codes).to(grid)
        share = share.scatter_add(1, chosen, torch.ones_like(chosen, dtype=share.dtype)) / chosen.shape[1]
        return {"pooled": entries.mean(dim=(2, 3)), "map": entries.flatten(1), "histogram": share}

    def reconstruct(self, images: base.Images) -> base.Images:
        return self.decode(self.quantise(self.encode(images))[0]).clamp(0, 1)

    def losses(self, images: base.Images, run: base.LossInputs) -> dict[str, Tensor]:
        """Squared error in -1..1, codebook and commitment terms; beside them L1 in 0..1 and ``codes_used``.

        ``codes_used`` is exp(entropy) of the entries chosen in this batch: from 1 (one entry for all) to K.
        """
        with run.precision():
            grid = self.encode(images).float()
        with _seeded(run.generator, grid.device):  # k-means, at the very first batch
            through, entries, indices = self.quantise(grid)
        with run.precision():
            again = self.decode(through)
        share = one_hot(indices.flatten(), self.settings.codes).float().mean(dim=0)
        terms = {
            "reconstruction": mse_loss(2 * again, 2 * images),
            "codebook": mse_loss(entries, grid.detach()),
            "commitment": run.config.objective.commitment * mse_loss(grid, entries.detach()),
            "l1": (again.detach().clamp(0, 1) - images).abs().mean(),
            "codes_used": torch.special.entr(share).sum().exp(),
        }
        if self.training:  # count which entries were chosen, replace those that hardly ever are
            with _seeded(run.generator, grid.device):
                self.codebook.update_indices(grid.detach().float(), indices)
        return terms


class Residual(nn.Module):
    """x + conv1(ReLU(norm(conv3(ReLU(x)))))."""

    def __init__(self, width: int, *, normalised: bool):
        super().__init__()
        norm = [nn.BatchNorm2d(width)] if normalised else []
        around, here = nn.Conv2d(width, width, 3, padding=1), nn.Conv2d(width, width, 1)
        self.layers = nn.Sequential(nn.ReLU(), around, *norm, nn.ReLU(), here)

    def forward(self, grid: Grid) -> Grid:
        return grid + self.layers(grid)


@contextmanager
def _seeded(generator: Generator, device: torch.device) -> Iterator[None]:
    """torch's global generators, which the library draws from, as a function of ours; put back afterwards."""
    seed = int(torch.randint(2**62, (), generator=generator))
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
