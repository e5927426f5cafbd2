"""Group normalisation followed by a (leaky) rectifier, in one pass over memory each way.

Source: Wu & He, Group Normalization (2018). Two implementations share one signature: ``reference`` (torch's
own operators, the definition, any device) and ``numba_cpu`` (float32 and float64 on the CPU, channels last;
a third of the time). Which one runs follows from the input alone.
"""

from jaxtyping import Float
from torch import Tensor, nn

from derender.networks.norm_relu import numba_cpu, reference

EPSILON = 1e-5


def norm_relu(
    values: Float[Tensor, "n c h w"],
    weight: Float[Tensor, " c"],
    bias: Float[Tensor, " c"],
    groups: int,
    slope: float = 0.0,
) -> Float[Tensor, "n c h w"]:
    """Normalise each group of channels of a picture, scale and shift, keep ``slope`` of what is negative."""
    implementation = numba_cpu if numba_cpu.suits(values, weight) else reference
    return implementation.norm_relu(values, weight, bias, groups, slope, EPSILON)


class NormReLU(nn.Module):
    """`norm_relu` with its scale and shift as parameters."""

    def __init__(self, channels: int, groups: int, slope: float = 0.0):
        super().__init__()
        norm = nn.GroupNorm(groups, channels, EPSILON)
        self.weight, self.bias = norm.weight, norm.bias
        self.groups, self.slope = groups, slope

    def forward(self, values: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return norm_relu(values, self.weight, self.bias, self.groups, self.slope)

    def extra_repr(self) -> str:
        return f"{len(self.weight)}, groups={self.groups}, slope={self.slope}"
