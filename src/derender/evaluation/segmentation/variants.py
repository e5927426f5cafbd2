"""The nets that are compared: which encoders, where their weights come from, and whether they are frozen.

Source: Klinghoffer et al., ECCV 2022, Table 3. Its only control is one encoder from fresh weights, while its
best row joins two: two fresh encoders, trained and frozen, are ours. A pre-trained encoder keeps its
BatchNorm statistics while its weights learn, since few labelled pictures make small batches, whose own say
little; a fresh one has none to keep. A fresh encoder that is frozen gets those of the training pictures.
The paper's decoder is always fresh; one net begins with the decoder that was taught beside the encoders, and
keeps statistics at its finest levels only.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from derender.data import as_float, suggestion
from derender.evaluation.segmentation.pixels import SegmentationData
from derender.networks.encoders import UNetEncoder
from derender.networks.unet import SegmentationNet

SETTLING_PICTURES = 512
_BATCH = 64


@dataclass(frozen=True)
class Variant:
    """One row of the table.

    Attributes:
        title: as shown.
        factors: whose encoders, joined in this order.
        pretrained: whether with the model's weights; otherwise fresh ones of the same shape.
        frozen: whether only the decoder learns; otherwise pre-trained encoders learn with their BatchNorm
            statistics kept.
        decoder: whether the decoder, too, begins with the model's weights (all but its last layer); otherwise
            it is fresh.
    """

    title: str
    factors: tuple[str, ...]
    pretrained: bool
    frozen: bool
    decoder: bool = False


_ONE, _BOTH = ("geometry",), ("geometry", "albedo")
VARIANTS: Mapping[str, Variant] = {
    "joint-whole": Variant("joint, decoder too", _BOTH, pretrained=True, frozen=False, decoder=True),
    "joint": Variant("joint encoders", _BOTH, pretrained=True, frozen=False),
    "geometry": Variant("geometry encoder", _ONE, pretrained=True, frozen=False),
    "albedo": Variant("albedo encoder", ("albedo",), pretrained=True, frozen=False),
    "joint-frozen": Variant("joint encoders, frozen", _BOTH, pretrained=True, frozen=True),
    "random": Variant("random start", _ONE, pretrained=False, frozen=False),
    "joint-random": Variant("random start, joint", _BOTH, pretrained=False, frozen=False),
    "joint-random-frozen": Variant("random, joint, frozen", _BOTH, pretrained=False, frozen=True),
}
"""By name on the command line."""


def chosen_variants(names: Sequence[str]) -> dict[str, Variant]:
    """Variants by name; an unknown one is an error that names the nearest."""
    for name in names:
        if name not in VARIANTS:
            raise ValueError(
                f"no variant {name!r}{suggestion(name, VARIANTS)}: there is {', '.join(VARIANTS)}"
            )
    if not names:
        raise ValueError(f"name a variant: there is {', '.join(VARIANTS)}")
    return {name: VARIANTS[name] for name in dict.fromkeys(names)}


def usual_variants(model: Any) -> dict[str, Variant]:
    """All that can be made of a model: those that begin with a taught decoder only where it has one."""
    has = getattr(model, "unet_decoder", None) is not None
    return {name: variant for name, variant in VARIANTS.items() if has or not variant.decoder}


def check_encoders(model: Any, variants: Mapping[str, Variant], source: str = "the model") -> None:
    """Raise ValueError where the model lacks a U-Net encoder, or the taught decoder, that a variant needs."""
    for factor in sorted({factor for variant in variants.values() for factor in variant.factors}):
        encoder = getattr(model.nets[factor], "encoder", None) if factor in model.nets else None
        if not isinstance(encoder, UNetEncoder):
            raise ValueError(
                f"{source} has no U-Net encoder for {factor}, and segmentation needs its skip features: "
                "make one with derender unet, or train one with derender train --set encoder=unet"
            )
    if any(variant.decoder for variant in variants.values()) and getattr(model, "unet_decoder", None) is None:
        raise ValueError(f"{source} has no U-Net decoder: make a copy that has with derender unet")


def build_variant(model: Any, variant: Variant, data: SegmentationData, seed: int) -> SegmentationNet:
    """A net to train; the model stays as it was, and so does torch's global generator.

    The seed makes the decoder and fresh encoders. Variants of equal shape start from the same decoder.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoders = [copy.deepcopy(model.nets[factor].encoder) for factor in variant.factors]
        decoder_seed = int(torch.randint(2**31, ()))
        if not variant.pretrained:
            for encoder in encoders:
                _start_afresh(encoder)
        torch.manual_seed(decoder_seed)
        net = SegmentationNet(
            encoders,
            len(data.classes),
            frozen=variant.frozen,
            kept_statistics=variant.pretrained,
            decoder=model.unet_decoder if variant.decoder else None,
        )
    net = net.to(model.device)
    if variant.frozen and not variant.pretrained:
        for encoder in encoders:
            _settle_statistics(encoder, data)
    return net


def _start_afresh(encoder: nn.Module) -> None:
    """New weights and statistics, drawn from torch's global generator."""
    for module in encoder.modules():
        if isinstance(module, nn.Conv2d | nn.BatchNorm2d):
            module.reset_parameters()


@torch.no_grad()
def _settle_statistics(encoder: nn.Module, data: SegmentationData) -> None:
    """Give every BatchNorm the mean statistics of batches of training pictures."""
    norms = [module for module in encoder.modules() if isinstance(module, nn.BatchNorm2d)]
    usual = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain mean over batches
    encoder.train()
    device = next(encoder.parameters()).device
    rows = data.train[:SETTLING_PICTURES]
    for part in np.array_split(rows, max(1, len(rows) // _BATCH)):
        encoder.spatial(as_float(data.images[part]).to(device))  # type: ignore[operator]
    encoder.eval()
    for norm, momentum in zip(norms, usual, strict=True):
        norm.momentum = momentum
