"""SSIM inside a mask: only windows that lie wholly inside it count.

Source: Wang et al., IEEE TIP 2004, computed by torchmetrics: a Gaussian window of 11 x 11 pixels with sigma
1.5, constants 0.01 and 0.03, pictures in 0..1, mean over colours. A window that reaches over the edge of the
mask would compare what nothing covers, so its centre is left out; with a full mask the score is torchmetrics'
own, which leaves out the same five pixels at the border of the picture. Leaves out several scales.
"""

import torch
from jaxtyping import Float
from torch import Tensor

WINDOW = 11
SIGMA = 1.5
AT_A_TIME = 32  # pictures: convolutions with windows this large take memory


def masked_ssim(
    prediction: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"], mask: Float[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """SSIM of pictures in 0..1 over the windows inside the mask, per picture; -1..1, best 1.

    NaN where no window of 11 x 11 pixels lies inside the mask. Values outside the mask do not matter, and may
    be anything, NaN included.
    """
    if min(target.shape[-2:]) < WINDOW:
        raise ValueError(
            f"SSIM needs pictures of {WINDOW} pixels or more each way, got {tuple(target.shape[-2:])}"
        )
    parts = [values.split(AT_A_TIME) for values in (prediction, target, mask)]
    return torch.cat([_some(*part) for part in zip(*parts, strict=True)])


def _some(
    prediction: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"], mask: Float[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """The same of a few pictures."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    covered = mask > 0
    inside = _windows_inside(covered)
    prediction, target = (torch.where(covered[:, None], p.float(), 0.0) for p in (prediction, target))
    _, similarity = structural_similarity_index_measure(
        prediction, target, data_range=1.0, sigma=SIGMA, reduction="none", return_full_image=True
    )
    total = torch.where(inside, torch.as_tensor(similarity).mean(dim=1), 0.0).sum(dim=(1, 2))
    return total.double() / inside.sum(dim=(1, 2))


def _windows_inside(covered: Tensor) -> Tensor:
    """Centres of the windows that lie inside the mask and inside the picture: (N, H, W) bool."""
    hole = torch.nn.functional.pad((~covered).float(), (WINDOW // 2,) * 4, value=1.0)
    return torch.nn.functional.max_pool2d(hole[:, None], WINDOW, stride=1)[:, 0] == 0
