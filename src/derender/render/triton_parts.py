"""What several Triton kernels share; importing this module imports Triton.

``lanes`` finds a program's image and lanes. ``accumulate`` adds to memory that other lanes add to as well. In
floating point the order, and so the last bits, change from run to run. Deterministic gradients are added as
integers, whose sums have no order. The integers' unit is set per image by the largest amount added anywhere
in it, which a first run of the same kernel finds (``note_largest``).
"""

import inspect
from collections.abc import Callable
from typing import Any

import triton
import triton.language as tl


def kernel(function: Callable[..., Any]) -> Any:
    """As `triton.jit`, of the function itself where type checks wrap it."""
    return triton.jit(inspect.unwrap(function))


@kernel
def lanes(per_image, BLOCK: tl.constexpr):
    """This program's image (int64, for addresses), its lanes within the image, and which of them exist."""
    program = tl.program_id(0)
    programs = tl.cdiv(per_image, BLOCK)
    image = (program // programs).to(tl.int64)
    lane = (program % programs) * BLOCK + tl.arange(0, BLOCK)
    return image, lane, lane < per_image


@kernel
def float64(bits):
    """The scalar that ``float64_bits`` packed."""
    return bits.to(tl.float64, bitcast=True)


@kernel
def magnitude(value, live):
    """|value| as an integer that orders like it (NaN above all), 0 where the lane is not live."""
    return tl.where(live, tl.abs(value.to(tl.float64)), 0.0).to(tl.int64, bitcast=True)


@kernel
def note_largest(target, value):
    """Raise ``target`` to the block's largest magnitude."""
    tl.atomic_max(target, tl.max(value, 0), sem="relaxed")


@kernel
def accumulate(target, value, live, unit, MODE: tl.constexpr):
    """Add ``value`` at ``target``: as it is, or in units (a scalar per image) as the nearest integer."""
    if MODE == 2:
        whole = tl.floor(value.to(tl.float64) * unit + 0.5).to(tl.int64)
        tl.atomic_add(target, whole, mask=live, sem="relaxed")
    else:
        tl.atomic_add(target, value.to(target.dtype.element_ty), mask=live, sem="relaxed")
