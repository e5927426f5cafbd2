"""The definition, by torch's own operators: any device, any floating dtype."""

from torch import Tensor
from torch.nn import functional


def norm_relu(
    values: Tensor, weight: Tensor, bias: Tensor, groups: int, slope: float, epsilon: float
) -> Tensor:
    """Group normalisation, then a rectifier that keeps ``slope`` of what is negative."""
    normalised = functional.group_norm(values, groups, weight, bias, epsilon)
    return functional.leaky_relu(normalised, slope) if slope else functional.relu(normalised)
