"""Sums that many lanes of a GPU kernel add to: in floating point, or as integers where runs must repeat.

Integer sums have no order, so with ``torch.use_deterministic_algorithms(True)`` gradients repeat bit for bit.
The unit is set per image by its largest summand and the number of summands, which leaves at least 44 bits
below that summand at 512x512. A summand that is not finite makes its image's sums NaN.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

ADD, MEASURE, ADD_INTEGERS = 0, 1, 2
"""What a kernel is asked to do: its ``MODE``."""

LARGEST_SUM = 2.0**62
SMALLEST_SUMMAND = 1e-280
"""Images whose every summand is smaller get zeros: the unit would not be finite."""

Run = Callable[[int, Tensor, Tensor, Sequence[Tensor]], None]


def scattered_sums(
    run: Run, like: Tensor, shapes: Sequence[tuple[int, ...]], dtypes: Sequence[torch.dtype]
) -> list[Tensor]:
    """Sums of these shapes (images first) and dtypes on ``like``'s device.

    ``run(mode, units, largest, targets)`` launches the kernel: it adds to ``targets``, in ``units`` (float64,
    one per image and target) where mode is ADD_INTEGERS; or raises ``largest`` (bits of float64) for MEASURE.
    """
    size = len(like), len(shapes)
    largest = torch.zeros(size, dtype=torch.int64, device=like.device)
    units = torch.ones(size, dtype=torch.float64, device=like.device)
    if not torch.are_deterministic_algorithms_enabled():
        sums = [
            torch.zeros(shape, dtype=dtype, device=like.device)
            for shape, dtype in zip(shapes, dtypes, strict=True)
        ]
        run(ADD, units, largest, sums)
        return sums
    run(MEASURE, units, largest, [largest] * len(shapes))
    most = largest.view(torch.float64)
    pixels = like.shape[-2] * like.shape[-1]
    units = torch.where(most > SMALLEST_SUMMAND, LARGEST_SUM / (pixels * most.clamp(min=SMALLEST_SUMMAND)), 0)
    whole = [torch.zeros(shape, dtype=torch.int64, device=like.device) for shape in shapes]
    run(ADD_INTEGERS, units, largest, whole)
    sizes = torch.where(
        units > 0, 1 / torch.where(units > 0, units, 1), most * 0
    )  # NaN if most is not finite
    return [
        (value * size.view(-1, *[1] * (value.dim() - 1))).to(dtype)
        for value, size, dtype in zip(whole, sizes.unbind(1), dtypes, strict=True)
    ]
