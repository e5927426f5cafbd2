"""Whether the installed PyTorch can be trusted with pickles of weights (.pth) that come from others.

Published networks exist as nothing else. torch's restricted reader makes tensors and plain values and runs
no code, but before PyTorch 2.10 a crafted file could corrupt memory through it (CVE-2026-24747). What is ours
is never a pickle (tensor_file.py).
"""

from pathlib import Path

import torch

SAFE_SINCE = "2.10.0"


def reads_safely() -> bool:
    """Whether the installed PyTorch is new enough."""
    return torch.__version__ >= SAFE_SINCE


def refuse_old_torch(file: str | Path) -> None:
    """Raise ValueError where a crafted ``file`` could make the installed PyTorch run code."""
    if not reads_safely():
        raise ValueError(
            f"{file} is a pickle, and PyTorch {torch.__version__} can be made to run code by a crafted one "
            f"(CVE-2026-24747): install PyTorch {SAFE_SINCE} or newer"
        )
