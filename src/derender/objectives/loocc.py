"""Leave-one-out, cycle contrastive loss (LOOCC): what was not perturbed must be recognised again.

Source: the paper, section 3.2; NT-Xent from SimCLR (Chen et al. 2020). Left open there: the perturbed factor
is drawn per image. By factor, an image is absent from the contrast of what was perturbed in it. The loss is
the mean over all contrasted (image, factor). A factor that fewer than two images kept is dropped. Jointly, as
Eq. 6 is written, the codes are compared side by side: for each image without the factor that was perturbed in
it, in all images alike. Leaves out the perturbation (scene/perturb.py) and the encoding of the new rendering.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from derender.objectives.reconstruction import at_least_float32

NOTHING_LEFT_OUT = -1
_NO_DIRECTION = 1e-12


def nt_xent(a: Float[Tensor, "n d"], b: Float[Tensor, "n d"], temperature: float = 0.5) -> Float[Tensor, ""]:
    """Normalised temperature-scaled cross entropy of N pairs (a[i], b[i]), symmetric, mean over 2N anchors.

    At least 0; log(2N - 1) when every code is the same. A code of zeros has no direction: similarity 0, no
    gradient.
    """
    everything = torch.ones(len(a), dtype=torch.bool, device=a.device)
    return _anchor_losses("codes", a, b, everything, temperature).mean()


def loocc_loss(
    features: Mapping[str, Float[Tensor, "n _"]], features_again: Mapping[str, Float[Tensor, "n _"]],
    perturbed: Int64[Tensor, " n"], temperature: float = 0.5, *, joint: bool = False,
) -> Float[Tensor, ""]:  # fmt: skip
    """NT-Xent between both encodings of every factor that was not perturbed, mean over what was contrasted.

    With ``joint`` of one code, the unperturbed factors' side by side (Eq. 6), mean over images.
    ``perturbed[i]`` is the place in ``tuple(features)`` of the factor that was perturbed in image i, or
    ``NOTHING_LEFT_OUT`` (-1). Gradient flows into both encodings; 0 if no factor kept two images.
    """
    names = tuple(features)
    if not names:
        raise ValueError("LOOCC needs the codes of at least one factor, got none")
    if set(names) != set(features_again):
        raise ValueError(f"both encodings need the same factors, got {names} and {tuple(features_again)}")
    asked = len(perturbed) > 0 and perturbed.device.type == "cpu"  # elsewhere asking would stop the device
    if asked and not NOTHING_LEFT_OUT <= int(perturbed.min()) <= int(perturbed.max()) < len(names):
        allowed = f"-1..{len(names) - 1} ({', '.join(names)})"
        raise ValueError(f"perturbed must lie in {allowed}, got {perturbed.tolist()}")
    if joint:
        device = next(iter(features.values())).device
        everything, losses = torch.ones(len(perturbed), dtype=torch.bool, device=device), []
        for left_out in range(NOTHING_LEFT_OUT, len(names) if len(names) > 1 else 0):
            kept = [name for place, name in enumerate(names) if place != left_out]
            code, again = (torch.cat([side[name] for name in kept], 1) for side in (features, features_again))
            own = (perturbed == left_out).repeat(2).to(device)
            losses.append(own * _anchor_losses("joint codes", code, again, everything, temperature))
        return torch.stack(losses).sum() / (2 * len(perturbed))
    totals, counts = [], []
    for index, (name, codes) in enumerate(features.items()):
        kept = (perturbed != index).to(codes.device)
        enough = kept.sum() >= 2
        losses = _anchor_losses(name, codes, features_again[name], kept, temperature)
        totals.append(losses.sum() / 2 * enough)
        counts.append(kept.sum() * enough)
    return torch.stack(totals).sum() / torch.stack(counts).sum().clamp(min=1)


def _anchor_losses(
    what: str, a: Tensor, b: Tensor, kept: Bool[Tensor, " n"], temperature: float
) -> Float[Tensor, " twice_n"]:
    """The loss of each of the 2N views among the kept ones; 0 for views of images that are not kept."""
    if a.shape != b.shape:
        raise ValueError(f"{what}: both encodings need one shape, got {tuple(a.shape)} and {tuple(b.shape)}")
    if len(a) < 2:
        raise ValueError(f"{what}: a contrastive loss needs at least 2 images in a batch, got {len(a)}")
    if not temperature > 0:
        raise ValueError(f"the temperature must be positive, got {temperature}")
    with torch.autocast(a.device.type, enabled=False):
        codes = _directions(torch.cat([at_least_float32(a), at_least_float32(b)]))
        views = torch.arange(len(codes), device=codes.device)
        kept = torch.cat([kept, kept])
        candidates = kept & (views != views.unsqueeze(1))
        logits = (codes @ codes.T / temperature).masked_fill(~candidates, float("-inf"))
        logits = torch.where(kept.unsqueeze(1), logits, 0.0)
        positive = (views + len(a)) % len(codes)
        return torch.where(kept, functional.cross_entropy(logits, positive, reduction="none"), 0.0)


def _directions(codes: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Unit vectors, safe for any magnitude: each code is first divided by its largest entry, a constant."""
    largest = codes.detach().abs().amax(dim=1, keepdim=True)
    has_direction = ~(largest <= _NO_DIRECTION)  # NaN stays NaN, and does not pass for a code without one
    codes = torch.where(has_direction, codes, 0.0) / torch.where(has_direction, largest, 1.0)
    return codes / torch.where(has_direction, codes, 1.0).norm(dim=1, keepdim=True)
