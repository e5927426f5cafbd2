"""Named tensors in a safetensors file that carries its own checksum; and which pickles of weights are safe.

The CRC-32 of names, kinds, shapes and values is in the file's metadata: a changed bit is an error and not
another model. Files made elsewhere have none. Published networks exist only as pickles (.pth): torch's
restricted reader runs no code, but before PyTorch 2.10 a crafted file could corrupt memory through it
(CVE-2026-24747). derender never writes a pickle.
"""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from derender.storage.atomic import write_whole
from derender.storage.bounded import require_regular

Tensors = Mapping[str, Tensor]
CHECKSUM = "crc32"
SAFE_SINCE = "2.10.0"  # version of PyTorch that reads pickles of weights safely
LIMIT_BYTES, _HEADER_BYTES = 2 << 30, 1 << 20
UNIT = ".unit"  # after a tensor's name: the unit that its bytes are in; read as their product


def write_tensors(tensors: Tensors, file: str | Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors with their checksum, whole or not at all; ``metadata`` is kept beside it."""
    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_whole(file, save(plain, {**(metadata or {}), CHECKSUM: checksum(plain)}))


def read_tensors(file: str | Path, like: Tensors | None = None) -> dict[str, Tensor]:
    """The tensors of a safetensors file, on the CPU; damage is a ValueError, no file an OSError.

    A file much larger than the expected tensors, which are ``like`` these, or than 2 GiB is not opened.
    """
    return read_described(file, like)[0]


def read_described(file: str | Path, like: Tensors | None = None) -> tuple[dict[str, Tensor], dict[str, str]]:
    """As ``read_tensors``, with the file's metadata. Copies are aligned: sums are those before saving."""
    expected = None if like is None else sum(value.numel() for value in like.values())
    most = LIMIT_BYTES if expected is None else min(LIMIT_BYTES, 16 * expected + _HEADER_BYTES)
    try:
        require_regular(Path(file), most)
        with safe_open(file, framework="pt") as stored:
            metadata = dict(stored.metadata() or {})
            tensors = {name: stored.get_tensor(name).clone() for name in stored.keys()}  # noqa: SIM118
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


def check_fit(weights: Tensors, expected: Tensors) -> None:
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


def require_plain(tensors: Mapping[str, Any], file: Path) -> None:
    """Raise ValueError for a tensor of a pickle that is not dense numbers on the CPU, all of them stored."""
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            continue
        odd = value.layout is not torch.strided or value.is_nested or value.is_meta or value.is_quantized
        if odd or value.is_complex():
            raise ValueError(f"{file}: {name!r} is no dense tensor of real numbers: not opened")
        if value.untyped_storage().nbytes() < value.numel() * value.element_size():
            raise ValueError(f"{file}: {name!r} claims {tuple(value.shape)}, more numbers than are stored")


def checksum(tensors: Tensors) -> str:
    """Eight hexadecimal digits that change with any name, kind, shape or bit."""
    result = 0
    for name, value in sorted(tensors.items()):
        result = zlib.crc32(f"{name} {value.dtype} {tuple(value.shape)}\0".encode(), result)
        if value.numel():
            result = zlib.crc32(value.contiguous().reshape(-1).view(torch.uint8).numpy().data, result)
    return f"{result:08x}"


def reads_safely() -> bool:
    """Whether the installed PyTorch is new enough to read pickles of weights."""
    return torch.__version__ >= SAFE_SINCE


def check_pickle(file: Path) -> None:
    """ValueError: a file is irregular, above 2 GiB, unpacks to more, or makes this PyTorch run code."""
    try:
        size = require_regular(file, LIMIT_BYTES)
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as archive:
                if sum(member.file_size for member in archive.infolist()) > size:
                    raise ValueError("it unpacks to more bytes than it holds")
    except (ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file} is no file of weights ({error}): not opened") from error
    if not reads_safely():
        why = f"PyTorch {torch.__version__} can be made to run code by a crafted one (CVE-2026-24747)"
        raise ValueError(f"{file} is a pickle, and {why}: install PyTorch {SAFE_SINCE} or newer")
