"""The networks that are compared, how they are trained, and their answers.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.7 and Table 3: Adam 2e-4 with betas 0.5 and 0.999, 20 epochs.
Neither the loss nor the batch size is stated: cross-entropy, and 64, or fewer of few images. To the paper's
control, one encoder from fresh weights, this table adds two fresh encoders. A pre-trained encoder keeps its
BatchNorm statistics while its weights learn. One network begins with the decoder that was distilled beside
the encoders. Leaves out augmentation, class weights and early stopping.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from derender.evaluation.segmentation.data import SegmentationData
from derender.features import map_batches, named
from derender.features.extract import as_batch
from derender.networks.encoders import UNetDecoder, UNetEncoder
from derender.settings import Settings
from derender.training.process import freed_memory_kept

LARGEST_BATCH, SMALLEST_BATCH, STEPS_AN_EPOCH = 64, 2, 320

LEVELS_KEPT = 2
"""Levels, finest first, whose BatchNorm keeps its statistics in encoders and a decoder trained together."""


@dataclass(frozen=True)
class Variant:
    """One row of the table, by its title: encoders of these factors, joined in this order, ``pretrained`` or
    fresh, ``frozen`` or learning; ``decoder``: it, too, begins with the model's weights (all but its last
    layer).
    """

    title: str
    factors: tuple[str, ...]
    pretrained: bool
    frozen: bool
    decoder: bool = False


_ONE, _BOTH = ("geometry",), ("geometry", "albedo")
VARIANTS: Mapping[str, Variant] = {
    "joint-whole": Variant("joint, decoder too", _BOTH, True, False, decoder=True),
    "joint": Variant("joint encoders", _BOTH, True, False),
    "geometry": Variant("geometry encoder", _ONE, True, False),
    "albedo": Variant("albedo encoder", ("albedo",), True, False),
    "joint-frozen": Variant("joint encoders, frozen", _BOTH, True, True),
    "random": Variant("random start", _ONE, False, False),
    "joint-random": Variant("random start, joint", _BOTH, False, False),
}
"""By name on the command line."""


class SegmentSettings(Settings):
    """Training of a network; without a batch size, ``batch_for`` chooses one."""

    learning_rate: float = Field(default=2e-4, gt=0)
    betas: tuple[float, float] = (0.5, 0.999)
    epochs: int = Field(default=20, ge=1)
    batch_size: int | None = Field(default=None, ge=2)

    def batch_for(self, images: int) -> int:
        """Images a step: 64, but fewer (2 at least) where an epoch would have less than 320 steps."""
        return self.batch_size or min(LARGEST_BATCH, max(SMALLEST_BATCH, images // STEPS_AN_EPOCH))


def chosen_variants(model: Any, names: Sequence[str] | None = None) -> dict[str, Variant]:
    """Variants by name, or all that the model allows: a U-Net decoder is needed by some.

    Raises:
        ValueError: an unknown name (with a suggestion), or the model lacks an encoder or decoder.
    """
    own_decoder = getattr(model, "unet_decoder", None) is not None
    if names is None:
        names = [name for name, variant in VARIANTS.items() if own_decoder or not variant.decoder]
    if not names:
        raise ValueError(f"name a variant: there is {', '.join(VARIANTS)}")
    chosen = {name: named(VARIANTS, name, "variant") for name in names}
    for factor in sorted({factor for variant in chosen.values() for factor in variant.factors}):
        encoder = getattr(model.nets[factor], "encoder", None) if factor in model.nets else None
        if not isinstance(encoder, UNetEncoder):
            raise ValueError(
                f"the model has no U-Net encoder for {factor}, and segmentation needs its skip features: "
                "make one with derender unet, or train one with derender train --set encoder=unet"
            )
    if any(variant.decoder for variant in chosen.values()) and not own_decoder:
        raise ValueError("the model has no U-Net decoder: make a copy that has with derender unet")
    return chosen


class SegmentationNet(nn.Module):
    """Images in 0..1 to one logit a class and pixel, from U-Net encoders and a decoder over all of them.

    ``frozen`` encoders never change. With ``kept_statistics`` their BatchNorm keeps its statistics. Beside a
    learnt ``decoder``, of which all but the last layer is taken, only the two finest levels of either do.
    """

    def __init__(
        self,
        encoders: Sequence[UNetEncoder],
        outputs: int,
        *,
        frozen: bool = False,
        kept_statistics: bool = False,
        decoder: UNetDecoder | None = None,
    ):
        super().__init__()
        self.encoders = nn.ModuleList(encoders).requires_grad_(not frozen)
        for encoder in encoders:
            encoder.to_code.requires_grad_(False)  # the code takes no part here
        if decoder is None:
            self.decoder = UNetDecoder(encoders[0].widths, len(encoders), outputs)
        else:
            self.decoder = copy.deepcopy(decoder).requires_grad_(True)
            last = decoder.to_outputs
            self.decoder.to_outputs = nn.Conv2d(last.in_channels, outputs, 1, device=last.weight.device)
        self.frozen = frozen
        self._fixed: list[nn.Module] = []  # parts whose BatchNorm keeps its statistics
        if decoder is not None:
            self._fixed = [encoder.levels[:LEVELS_KEPT] for encoder in encoders]
            self._fixed.append(self.decoder.convolve[-LEVELS_KEPT:])
        elif frozen or kept_statistics:
            self._fixed = [self.encoders]

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def train(self, mode: bool = True) -> "SegmentationNet":
        super().train(mode)
        for part in self._fixed:
            part.eval()
        return self

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n outputs h w"]:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            levels = zip(*(encoder.skips(images) for encoder in self.encoders), strict=True)  # type: ignore[operator]
            joined = [torch.cat(level, dim=1) for level in levels]
        return self.decoder(joined)


def build_variant(model: Any, variant: Variant, data: SegmentationData, seed: int) -> SegmentationNet:
    """A network to train; the model stays as it was, and so does torch's global generator.

    The seed makes the decoder and fresh encoders. Variants of equal shape start from the same decoder.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoders = [copy.deepcopy(model.nets[factor].encoder) for factor in variant.factors]
        decoder_seed = int(torch.randint(2**31, ()))
        if not variant.pretrained:
            for module in (module for encoder in encoders for module in encoder.modules()):
                if isinstance(module, nn.Conv2d | nn.BatchNorm2d):
                    module.reset_parameters()
        torch.manual_seed(decoder_seed)
        how = {"frozen": variant.frozen, "kept_statistics": variant.pretrained}
        decoder = model.unet_decoder if variant.decoder else None
        return SegmentationNet(encoders, len(data.classes), decoder=decoder, **how).to(model.device)


def train_segmenter(
    net: SegmentationNet,
    data: SegmentationData,
    seed: int,
    settings: SegmentSettings,
    progress: Callable[[int, float], object] | None = None,
) -> list[float]:
    """Train in place on the training rows; the mean loss of each epoch.

    The seed orders the images; ``progress`` is called with (images seen, loss) after every step.
    """
    net.to(memory_format=torch.channels_last).train()  # pyright: ignore[reportCallIssue]
    learning = [parameter for parameter in net.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam(learning, lr=settings.learning_rate, betas=settings.betas, fused=True)
    generator, seen, means = torch.Generator().manual_seed(seed), 0, []
    batch_size = settings.batch_for(len(data.train))
    with freed_memory_kept() if net.device.type == "cpu" else nullcontext():
        for _ in range(settings.epochs):
            order = data.train[torch.randperm(len(data.train), generator=generator).numpy()]
            total = 0.0
            for start in range(0, len(order), batch_size):
                rows = order[start : start + batch_size]
                truth = torch.from_numpy(data.masks[rows]).to(net.device).long()
                loss = cross_entropy(net(as_batch(data.images[rows], net.device)), truth)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                value = loss.item()
                total, seen = total + value * len(rows), seen + len(rows)
                if progress is not None:
                    progress(seen, value)
            means.append(total / len(order))
    return means


def answer(net: SegmentationNet, images: np.ndarray) -> np.ndarray:
    """(N, S, S) uint8: the likeliest class of every pixel of (N, 3, S, S) uint8 images."""

    def likeliest(batch: Tensor) -> np.ndarray:
        return net(batch).argmax(dim=1).to(torch.uint8).cpu().numpy()

    return np.concatenate(map_batches(likeliest, net, images, batch_size=128))
