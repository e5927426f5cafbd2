"""A saved model in fewer bytes: weights in half precision, large maps in bytes with a unit for each slice."""

import re
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from derender.storage import folder as files
from derender.storage.atomic import new_folder
from derender.storage.bounded import read_bounded
from derender.storage.places import model_folder
from derender.storage.tensors import UNIT, packed, read_described, write_tensors

KINDS = ("bytes", "float16")
"""How the large maps of whitening and fitting are kept; weights are kept in float16 by both."""

_LARGE = re.compile(r"\w+_map|maps\.\w+_axes")


@dataclass(frozen=True)
class Packed:
    """What was written: the folder, and the bytes of the tensors' files by file, before and after."""

    folder: Path
    before: dict[str, int]
    after: dict[str, int]


def pack_model(
    source: str | Path, folder: str | Path, *, maps: str = "bytes", overwrite: bool = False
) -> Packed:
    """Write a model in fewer bytes, with what lies beside its weights; complete or not at all.

    ``maps`` are kept as "bytes", a 127th of the largest number of each slice apart, or "float16". A
    FileExistsError: ``folder`` exists, without ``overwrite``; a FileNotFoundError: no model is at ``source``;
    a ValueError: it is damaged, or a weight is no number of half precision.
    """
    if maps not in KINDS:
        raise ValueError(f"unknown kind of maps {maps!r}: choose {' or '.join(KINDS)}")
    folder, own = Path(folder), model_folder(source)
    files.read_config(own)
    before, after = {}, {}
    with new_folder(folder, overwrite=overwrite) as temporary:
        for file in files.TENSOR_FILES:
            if not (own / file).is_file():
                continue
            tensors, metadata = read_described(own / file)
            small = dict(tensors)
            for name, value in tensors.items():
                if file == files.WEIGHTS_FILE:
                    small[name] = _half(name, value) if value.is_floating_point() else value
                elif _LARGE.fullmatch(name) and maps == "bytes":
                    small[name], small[name + UNIT] = packed(value.float(), along=0)
                elif _LARGE.fullmatch(name):
                    small[name] = _half(name, value)
            write_tensors(small, temporary / file, metadata)
            before[file], after[file] = ((place / file).stat().st_size for place in (own, temporary))
        for file in (files.CONFIG_FILE, *files.TEXT_FILES):
            if (own / file).is_file():
                (temporary / file).write_bytes(read_bounded(own / file))
    return Packed(folder, before, after)


def _half(name: str, value: Tensor) -> Tensor:
    half = value.half()
    if not bool(half.isfinite().all()):
        raise ValueError(
            f"{name} has numbers that half precision cannot hold (beyond 65,504, or NaN), so this model "
            "cannot be packed: its training went wrong, train it again"
        )
    return half
