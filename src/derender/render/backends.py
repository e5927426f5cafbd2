"""Which implementation of an operation runs: plain torch (the definition), Numba (CPU) or Triton (CUDA).

All three share one signature. Triton also runs on the CPU in its interpreter, slowly, for tests.
"""

import importlib.util

import torch

from derender.render.triton_launch import interpreted, triton_installed

BACKENDS = ("auto", "reference", "numba", "triton")
_NUMBA = importlib.util.find_spec("numba") is not None  # here, as torch 2.6 cannot trace it


def available_backends() -> tuple[str, ...]:
    """Names that ``backend=`` accepts on this machine, besides ``auto``; ``triton`` for its GPU."""
    triton = triton_installed() and (torch.cuda.is_available() or interpreted())
    return ("reference", *["numba"] * _numba_installed(), *["triton"] * triton)


def chosen_backend(device: torch.device | str, backend: str = "auto") -> str:
    """The implementation that ``backend`` means for tensors on ``device``; an impossible one is an error."""
    kind = torch.device(device).type
    if backend not in BACKENDS:
        raise ValueError(f"unknown render backend {backend!r}; choose one of {', '.join(BACKENDS)}")
    if backend == "auto":
        best = {"cpu": "numba", "cuda": "triton"}.get(kind, "reference")
        missing = not (_numba_installed() if best == "numba" else triton_installed())
        return "reference" if missing else best
    if backend == "reference":
        return backend
    if not (_numba_installed() if backend == "numba" else triton_installed()):
        raise ValueError(
            f"the {backend} render backend needs the package {backend}; install it or use 'reference'"
        )
    if backend == "numba" and kind != "cpu":
        raise ValueError(f"the numba render backend works on the CPU, the tensors are on {kind}; use 'auto'")
    if backend == "triton" and kind != "cuda" and not interpreted():
        raise ValueError(
            f"the triton render backend works on a CUDA device, the tensors are on {kind}; use 'auto', or "
            "set TRITON_INTERPRET=1 before Python starts to try it on the CPU, slowly"
        )
    return backend


def _numba_installed() -> bool:
    return _NUMBA
