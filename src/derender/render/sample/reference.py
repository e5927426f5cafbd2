"""Bilinear look-up in plain torch: the definition, on any device."""

import torch
from torch import Tensor


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """(N, C, H2, W2): the image's value at each (u, v); 0 with no gradient where the mask is 0."""
    count, channels, height, width = image.shape
    uv = torch.where(mask[..., None] > 0, uv, 0)
    left = uv[..., 0].detach().floor().clamp(0, width - 2)
    top = uv[..., 1].detach().floor().clamp(0, height - 2)
    across, down = (uv[..., 0] - left)[:, None], (uv[..., 1] - top)[:, None]
    corner = (top * width + left).long().flatten(1)[:, None].expand(-1, channels, -1)

    def look_up(step: int) -> Tensor:
        return image.flatten(2).gather(2, corner + step).view(count, channels, *mask.shape[1:])

    upper = look_up(0) * (1 - across) + look_up(1) * across
    lower = look_up(width) * (1 - across) + look_up(width + 1) * across
    return torch.where(mask[:, None] > 0, upper * (1 - down) + lower * down, 0)
