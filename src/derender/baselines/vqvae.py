"""VQ-VAE: an image becomes a grid of entries of a learnt codebook, and an image again.

Source: van den Oord et al., *Neural Discrete Representation Learning* (2017), in the size that the paper
compares with (two convolutions k4 s2 p1, two residual blocks of ReLU, conv3, BatchNorm, ReLU, conv1,
BatchNorm between). The paper says 416 channels and 19,199,491 parameters; that count is the one of 512
channels, 416 have 12,724,195: both are offered (``width``). Both counts hold for eight BatchNorms, 512 codes
as trainable parameters, and biases throughout; they say nothing of where the eight stand. Here: one after
each convolution and each residual block of the encoder, one inside each of its blocks, one between the
decoder's blocks and one between its transposed convolutions.

The codebook is the `VectorQuantize` of vector-quantize-pytorch (MIT), learnt by gradient as in the source
(codebook term + 0.25 commitment), started by k-means on the first batch; entries that hardly any place chose
of late are replaced by places of the batch. Leaves out the prior over codes that samples new images.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int64
from pydantic import Field
from torch import Generator, Tensor, nn
from torch.nn.functional import mse_loss, one_hot

from derender.baselines.model import BaselineModel, BaselineSettings, Images, LossInputs, optional
from derender.settings import Settings
from derender.training.config import LoopSettings, OptimiserSettings


class VqvaeSettings(BaselineSettings):
    """Sizes: channels (D) and entries of the codebook (K). Images are any multiple of 4 pixels wide."""

    image_size: int = Field(default=64, ge=8, multiple_of=4)
    width: int = Field(default=512, ge=1)
    codes: int = Field(default=512, ge=2)
    dead_below: float = Field(default=1.0, ge=0)  # places a batch, averaged; 0: entries are never replaced


class VqvaeObjective(Settings):
    """Weight of the commitment term; the source finds 0.1 to 2 to do alike."""

    commitment: float = Field(default=0.25, ge=0)


class VqvaeConfig(LoopSettings):
    """One training run of a VQ-VAE; the learning rate is that of the paper's text."""

    baseline: Literal["vqvae"] = "vqvae"
    model: VqvaeSettings = VqvaeSettings()
    objective: VqvaeObjective = VqvaeObjective()
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=1e-3, weight_decay=0.0)


@dataclass(frozen=True)
class Quantised:
    """A grid of places, each at its nearest entry.

    Attributes:
        through: the entries; gradients pass straight through to the input.
        entries: the entries; gradients reach the codebook.
        indices: which.
    """

    through: Float[Tensor, "n d h w"]
    entries: Float[Tensor, "n d h w"]
    indices: Int64[Tensor, "n h w"]


class Vqvae(BaselineModel):
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
        self.encoder = nn.Sequential(
            nn.Conv2d(3, width, 4, stride=2, padding=1),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            nn.Conv2d(width, width, 4, stride=2, padding=1),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            Residual(width, normalised=True),
            nn.BatchNorm2d(width),
            Residual(width, normalised=True),
            nn.BatchNorm2d(width),
        )
        library = optional("vector_quantize_pytorch", "the baseline vqvae")
        self.codebook = library.VectorQuantize(
            dim=width,
            codebook_size=settings.codes,
            accept_image_fmap=True,
            learnable_codebook=True,
            ema_update=False,
            rotation_trick=False,
            kmeans_init=True,
            commitment_weight=0.0,
            threshold_ema_dead_code=settings.dead_below,
        )
        self.decoder = nn.Sequential(
            Residual(width, normalised=False),
            nn.BatchNorm2d(width),
            Residual(width, normalised=False),
            nn.ConvTranspose2d(width, width, 4, stride=2, padding=1),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            nn.ConvTranspose2d(width, 3, 4, stride=2, padding=1),
        )

    def encode(self, images: Images) -> Float[Tensor, "n d gh gw"]:
        """Images in 0..1 to a grid of a quarter of their side, not yet quantised."""
        return self.encoder(images * 2 - 1)

    def quantise(self, grid: Float[Tensor, "n d h w"]) -> Quantised:
        """The nearest entry for every place."""
        through, indices, _ = self.codebook(grid.float(), freeze_codebook=True)
        return Quantised(through, self.codebook.get_codes_from_indices(indices), indices)

    def decode(self, grid: Float[Tensor, "n d gh gw"]) -> Images:
        """Images, about 0..1 but not clipped."""
        return self.decoder(grid).float() / 2 + 0.5

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        quantised = self.quantise(self.encode(images))
        return {
            "pooled": quantised.entries.mean(dim=(2, 3)),
            "map": quantised.entries.flatten(1),
            "histogram": one_hot(quantised.indices.flatten(1), self.settings.codes).float().mean(dim=1),
        }

    def shown(self, images: Images, config: Any) -> dict[str, Images]:
        again = self.decode(self.quantise(self.encode(images)).through).clamp(0, 1)
        return {"input": images, "reconstruction": again}

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Squared error in -1..1, codebook and commitment terms; beside them L1 in 0..1 and ``codes_used``.

        ``codes_used`` is exp(entropy) of the entries chosen in this batch: from 1 (one entry for all) to K.
        """
        with run.precision():
            grid = self.encode(images).float()
        with _seeded(run.generator, grid.device):  # k-means, at the very first batch
            quantised = self.quantise(grid)
        with run.precision():
            again = self.decode(quantised.through)
        terms = {
            "reconstruction": mse_loss(2 * again, 2 * images),
            "codebook": mse_loss(quantised.entries, grid.detach()),
            "commitment": run.config.objective.commitment * mse_loss(grid, quantised.entries.detach()),
            "l1": (again.detach().clamp(0, 1) - images).abs().mean(),
            "codes_used": codes_used(quantised.indices, self.settings.codes),
        }
        if self.training:  # count which entries were chosen, replace those that hardly ever are
            with _seeded(run.generator, grid.device):
                self.codebook.update_indices(grid.detach().float(), quantised.indices)
        return terms


class Residual(nn.Module):
    """x + conv1(ReLU(norm(conv3(ReLU(x)))))."""

    def __init__(self, width: int, *, normalised: bool):
        super().__init__()
        norm = [nn.BatchNorm2d(width)] if normalised else []
        self.layers = nn.Sequential(
            nn.ReLU(), nn.Conv2d(width, width, 3, padding=1), *norm, nn.ReLU(), nn.Conv2d(width, width, 1)
        )

    def forward(self, grid: Float[Tensor, "n d h w"]) -> Float[Tensor, "n d h w"]:
        return grid + self.layers(grid)


def codes_used(indices: Int64[Tensor, "n h w"], codes: int) -> Float[Tensor, ""]:
    """exp(entropy) of the entries: 1 if all places are at one, ``codes`` if spread evenly over all."""
    share = one_hot(indices.flatten(), codes).float().mean(dim=0)
    return torch.special.entr(share).sum().exp()


@contextmanager
def _seeded(generator: Generator, device: torch.device) -> Iterator[None]:
    """torch's global generators, which the library draws from, as a function of ours; put back afterwards."""
    seed = int(torch.randint(2**62, (), generator=generator))
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
