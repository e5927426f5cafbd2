"""The template start: at first all pictures of a batch share one geometry and one albedo; ours.

A picture's pose can be explained by its camera, or by a geometry and an albedo that have moved: nothing in
the reconstruction prefers the camera (for left and right the flipped twin does, for up and down nothing).
While all pictures share the same maps only camera and light can explain what differs between them, so both
learn to. Then each picture's own code is let in little by little. Leaves out which factors are shared.
"""

from collections.abc import Collection, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from derender.training.config import ObjectiveSettings
from derender.training.distributed import ALONE, Ranks


def own_share(objective: ObjectiveSettings, done: float) -> float:
    """How much of its own maps a picture has with this share of the run done: 0 all shared, 1 all its own."""
    if done < objective.template_share:
        return 0.0
    if objective.release_share == 0:
        return 1.0
    return min((done - objective.template_share) / objective.release_share, 1.0)


def share_codes(
    codes: Mapping[str, Float[Tensor, "n _"]], names: Collection[str], own: float, ranks: Ranks = ALONE
) -> dict[str, Float[Tensor, "n _"]]:
    """The codes of the named factors moved to their mean over the batch, which ``ranks`` may share.

    ``own`` = 1 leaves all as it is.
    """
    if own >= 1:
        return dict(codes)
    return {
        name: torch.lerp(_mean(code, ranks).expand_as(code), code, own) if name in names else code
        for name, code in codes.items()
    }


def _mean(code: Float[Tensor, "n _"], ranks: Ranks) -> Float[Tensor, "1 _"]:
    return ranks.gather(code).mean(dim=0, keepdim=True).to(code.dtype)
