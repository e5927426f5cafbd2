"""How Triton kernels are launched here: one row of programs per image, in the order of the images.

Every kernel works on ``per_image`` lanes of each image: its pixels, vertices or triangles. A block never
straddles two images, so sums over a block belong to one image. Kernels run without fused multiply-add: which
triangle a pixel shows is decided by float64 arithmetic that must round like the definition's. With
TRITON_INTERPRET=1 in the environment, set before Triton is imported, they run on the CPU, slowly, for tests.
"""

import os
import struct
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

INTERPRETED_BLOCK = 4096  # lanes per program in the interpreter: its time goes by operations, hardly by lanes

PIXELS_PER_PROGRAM = 128
TRIANGLES_PER_PROGRAM = 32  # one warp: lanes wait for the largest triangle among them, so there should be few

ADD, MEASURE, ADD_INTEGERS = 0, 1, 2  # what a kernel is asked to do: its ``MODE``

LARGEST_SUM = 2.0**62
SMALLEST_SUMMAND = 1e-280  # images whose every summand is smaller get zeros: the unit would not be finite

Run = Callable[[int, Tensor, Tensor, Sequence[Tensor]], None]


def interpreted() -> bool:
    """Whether kernels run in Triton's interpreter, on the CPU."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def block_of(lanes: int) -> int:
    return INTERPRETED_BLOCK if interpreted() else lanes


def programs_per_image(per_image: int, lanes: int = PIXELS_PER_PROGRAM) -> int:
    return -(-per_image // block_of(lanes))


def float64_bits(value: float) -> int:
    """A kernel's scalar argument at full precision: Triton would pass a float in 32 bits."""
    return struct.unpack("<q", struct.pack("<d", value))[0]


def launch(
    kernel: Any, images: Tensor, per_image: int, *arguments: Any, lanes: int = PIXELS_PER_PROGRAM,
    **constants: Any,
) -> None:  # fmt: skip
    """Run ``kernel(*arguments, BLOCK=…, **constants)`` over ``per_image`` lanes of each row of ``images``."""
    programs = len(images) * programs_per_image(per_image, lanes)
    if programs == 0:
        return
    constants |= {"BLOCK": block_of(lanes), "num_warps": max(1, lanes // 32), "enable_fp_fusion": False}
    with torch.cuda.device(images.device) if images.is_cuda else nullcontext():
        kernel[(programs,)](*arguments, **constants)


def scattered_sums(
    run: Run, like: Tensor, shapes: Sequence[tuple[int, ...]], dtypes: Sequence[torch.dtype]
) -> list[Tensor]:
    """Sums, of these shapes (images first) and dtypes, that many lanes add to, on ``like``'s device.

    They are made in floating point, or, with ``torch.use_deterministic_algorithms(True)``, as integers, which
    have no order, so that gradients repeat bit for bit. Their unit is set per image by its largest summand
    and the number of summands. At 512x512 at least 44 bits are left below that summand. A summand that is not
    finite makes its image's sums NaN. ``run(mode, units, largest, targets)`` launches the kernel: it adds to
    ``targets``, in ``units`` (float64, one per image and target) where mode is ADD_INTEGERS; or raises
    ``largest`` (bits of float64) for MEASURE.
    """
    largest = like.new_zeros((len(like), len(shapes)), dtype=torch.int64)
    units = torch.ones_like(largest, dtype=torch.float64)
    if not torch.are_deterministic_algorithms_enabled():
        sums = [like.new_zeros(shape, dtype=dtype) for shape, dtype in zip(shapes, dtypes, strict=True)]
        run(ADD, units, largest, sums)
        return sums
    run(MEASURE, units, largest, [largest] * len(shapes))
    most, pixels = largest.view(torch.float64), like.shape[-2] * like.shape[-1]
    units = torch.where(most > SMALLEST_SUMMAND, LARGEST_SUM / (pixels * most.clamp(min=SMALLEST_SUMMAND)), 0)
    whole = [like.new_zeros(shape, dtype=torch.int64) for shape in shapes]
    run(ADD_INTEGERS, units, largest, whole)
    sizes = torch.where(units > 0, 1 / units, most * 0)  # NaN if most is not finite
    return [
        (value * size.view(-1, *[1] * (value.dim() - 1))).to(dtype)
        for value, size, dtype in zip(whole, sizes.unbind(1), dtypes, strict=True)
    ]
