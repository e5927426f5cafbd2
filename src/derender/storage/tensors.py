"""Named tensors in a safetensors file that carries its own checksum; and which pickles of weights are safe.

The CRC-32 of names, kinds, shapes and values is in the file's metadata, so that a changed bit is an error and
not another model; files made elsewhere have none. Published networks exist only as pickles (.pth): torch's
restricted reader runs no code, but before PyTorch 2.10 a crafted file could corrupt memory through it
(CVE-2026-24747). derender never writes a pickle.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

CHECKSUM = "crc32"
SAFE_SINCE = "2.10.0"  # version of PyTorch that reads pickles of weights safely
UNIT = ".unit"
"""A tensor of bytes is in the unit that lies beside it under its name and this: read as their product."""


def write_tensors(
    tensors: Mapping[str, Tensor], file: str | Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write tensors, on whatever device, with their checksum; ``metadata`` is kept beside it."""
    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    Path(file).write_bytes(save(plain, {**(metadata or {}), CHECKSUM: checksum(plain)}))


def read_tensors(file: str | Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file, on the CPU; damage is a ValueError, no file an OSError."""
    return read_described(file)[0]


def read_described(file: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """As ``read_tensors``, with the file's metadata."""
    try:
        with safe_open(file, framework="pt") as stored:
            metadata = dict(stored.metadata() or {})
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118, not a mapping
    except (SafetensorError, RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{Path(file).name} is cut off or no safetensors file ({error})") from error
    if metadata.get(CHECKSUM, checksum(tensors)) != checksum(tensors):
        raise ValueError(f"{Path(file).name} has changed since it was written: its checksum differs")
    plain = {name: value for name, value in tensors.items() if not name.endswith(UNIT)}
    for unit_name in tensors.keys() - plain.keys():
        name, unit = unit_name.removesuffix(UNIT), tensors[unit_name]
        value = plain.get(name)
        if value is None or value.dtype != torch.int8 or value.ndim != unit.ndim:
            raise ValueError(f"{unit_name} is the unit of no tensor in the file")
        if any(one not in (1, size) for one, size in zip(unit.shape, value.shape, strict=True)):
            raise ValueError(f"{unit_name} does not fit: {tuple(unit.shape)} beside {tuple(value.shape)}")
        plain[name] = value.float() * unit.float()
    return plain, metadata


def check_fit(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Raise ValueError where a weight is missing, has another shape or is not expected; names the first."""
    for name, value in expected.items():
        if name not in weights:
            raise ValueError(f"it has no {name!r}, which this architecture needs")
        if weights[name].shape != value.shape:
            there, here = tuple(weights[name].shape), tuple(value.shape)
            raise ValueError(f"{name!r} has shape {there} there and {here} in this architecture")
    for name in weights:
        if name not in expected:
            raise ValueError(f"it has {name!r}, which this architecture lacks")


def packed(value: Tensor, along: int) -> tuple[Tensor, Tensor]:
    """A tensor as bytes, and their unit: a 127th of the largest number of each slice along one axis."""
    others = [axis for axis in range(value.ndim) if axis != along]
    unit = value.abs().amax(dim=others, keepdim=True).clamp(min=torch.finfo(torch.float32).tiny) / 127
    return (value / unit).round().to(torch.int8), unit.float()


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """Eight hexadecimal digits that change with any name, kind, shape or bit."""
    found = 0
    for name, value in sorted(tensors.items()):
        found = zlib.crc32(f"{name} {value.dtype} {tuple(value.shape)}\0".encode(), found)
        if value.numel():
            found = zlib.crc32(value.contiguous().reshape(-1).view(torch.uint8).numpy().data, found)
    return f"{found:08x}"


def reads_safely() -> bool:
    """Whether the installed PyTorch is new enough to read pickles of weights."""
    return torch.__version__ >= SAFE_SINCE


def refuse_old_torch(file: str | Path) -> None:
    """Raise ValueError where a crafted ``file`` could make the installed PyTorch run code."""
    if not reads_safely():
        raise ValueError(
            f"{file} is a pickle, and PyTorch {torch.__version__} can be made to run code by a crafted one "
            f"(CVE-2026-24747): install PyTorch {SAFE_SINCE} or newer"
        )
