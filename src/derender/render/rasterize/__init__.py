"""Rasterise a depth map's grid mesh: for each pixel, which canonical pixel coordinates it shows, and how far.

The mesh has two triangles a cell; vertex (v, u) of the grid carries its own pixel coordinates. Three
implementations share one signature: ``reference`` (plain torch, the definition), ``numba`` (CPU), ``triton``
(CUDA; on the CPU only in Triton's interpreter, for tests).

Which triangle a pixel shows is decided in float64, identically in every implementation:
* a triangle takes part if all its vertices have z > NEAR_Z and twice its area exceeds MIN_TWICE_AREA_PX2;
  both faces are seen;
* it covers a pixel if the three barycentric weights are at least -EDGE_TOLERANCE (edges are inclusive, and
  rounding cannot open a seam or a border);
* the nearest wins; of those within TIE_TOLERANCE (relative, in inverse depth) of the nearest, the first wins.

With the winner fixed, uv and depth are differentiable functions of its vertices: the point where the pixel's
ray meets the triangle's plane. Nothing flows at occlusion edges.
"""

import importlib.util
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from derender.render.rasterize import numba_cpu, reference, triton_gpu
from derender.render.triton_launch import interpreted, triton_installed

IMPLEMENTATIONS = {"reference": reference, "numba": numba_cpu, "triton": triton_gpu}
BACKENDS = ("auto", *IMPLEMENTATIONS)
_NUMBA = importlib.util.find_spec("numba") is not None  # here, as torch 2.6 cannot trace it


@dataclass(frozen=True)
class Fragments:
    """What each pixel shows.

    Attributes:
        uv: (N, H, W, 2) canonical pixel coordinates, u right and v down; 0 where nothing is seen.
        depth: (N, H, W) z of the visible surface in the camera frame; 0 where nothing is seen.
        mask: (N, H, W) 1 where a triangle is seen, else 0.
    """

    uv: Float[Tensor, "n h w 2"]
    depth: Float[Tensor, "n h w"]
    mask: Float[Tensor, "n h w"]


def rasterize(vertices: Float[Tensor, "n h w 3"], focal_px: float, backend: str = "auto") -> Fragments:
    """Rasterise the grid mesh with these vertices (camera frame) into an image of the grid's own size."""
    height, width = vertices.shape[1:3]
    if height < 2 or width < 2:
        raise ValueError(f"a grid mesh needs at least 2x2 vertices, got {height}x{width}")
    if not focal_px > 0:
        raise ValueError(f"the focal length must be positive, got {focal_px} pixels")
    implementation = IMPLEMENTATIONS[chosen_backend(vertices.device, backend)]
    uv, depth, triangle = implementation.rasterize(vertices, focal_px)
    return Fragments(uv, depth, (triangle >= 0).to(vertices.dtype))


def available_backends() -> tuple[str, ...]:
    """Names that ``backend=`` accepts on this machine, besides ``auto``; ``triton`` for its GPU."""
    triton = triton_installed() and (torch.cuda.is_available() or interpreted())
    return ("reference", *["numba"] * _numba_installed(), *["triton"] * triton)


def chosen_backend(device: torch.device | str, backend: str = "auto") -> str:
    """The implementation that ``backend`` means for tensors on ``device``; an impossible wish is an error."""
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
