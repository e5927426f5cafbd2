"""How Triton kernels are launched here: one row of programs per image, in the order of the images.

Every kernel works on ``per_image`` lanes of each image (its pixels, vertices or triangles), in blocks that
never straddle two images, so that sums over a block belong to one image. Kernels run without fused
multiply-add: which triangle a pixel shows is decided by float64 arithmetic that must round like the
definition's. With TRITON_INTERPRET=1 in the environment, set before Triton is imported, the same kernels run
on the CPU, slowly, for tests.
"""

import importlib.util
import os
import struct
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

INTERPRETED_BLOCK = 4096
"""Lanes per program in the interpreter, whose time goes by operations and hardly by lanes."""

PIXELS_PER_PROGRAM = 128
TRIANGLES_PER_PROGRAM = 32
"""One warp: lanes wait for the largest triangle among them, so there should be few."""


_TRITON = importlib.util.find_spec("triton") is not None  # here, as torch 2.6 cannot trace it


def triton_installed() -> bool:
    return _TRITON


def interpreted() -> bool:
    """Whether kernels run in Triton's interpreter, on the CPU."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def block_of(lanes_per_program: int) -> int:
    return INTERPRETED_BLOCK if interpreted() else lanes_per_program


def programs_per_image(per_image: int, lanes_per_program: int) -> int:
    return -(-per_image // block_of(lanes_per_program))


def float64_bits(value: float) -> int:
    """A kernel's scalar argument at full precision: Triton would pass a float in 32 bits."""
    return struct.unpack("<q", struct.pack("<d", value))[0]


def launch(
    kernel: Any,
    images: Tensor,
    per_image: int,
    *arguments: Any,
    lanes: int = PIXELS_PER_PROGRAM,
    **constants: Any,
) -> None:
    """Run ``kernel(*arguments, BLOCK=…, **constants)`` over ``per_image`` lanes of each row of ``images``."""
    programs = len(images) * programs_per_image(per_image, lanes)
    if programs == 0:
        return
    with torch.cuda.device(images.device) if images.is_cuda else nullcontext():
        kernel[(programs,)](
            *arguments,
            BLOCK=block_of(lanes),
            num_warps=max(1, lanes // 32),
            enable_fp_fusion=False,
            **constants,
        )
