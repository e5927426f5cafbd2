"""The weights in a checkpoint of unsup3d (Wu et al., CVPR 2020), as those of our networks.

Tensors are matched by net (``netD`` depth, ``netA`` albedo, ``netL`` light, ``netV`` view, ``netC``
confidence) and order, and every shape is compared. 1x1 convolutions become linear layers, and light comes as
(ambient, diffuse, x, y) where derender has pitch, y, first. The file is a pickle, read with torch's reader
for weights: other objects become empty ones, no code is run. Leaves out the ranges, which no file holds.
"""

import pickle
import re
import warnings
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.serialization import safe_globals

from derender.networks.decoders import ConfidenceNet
from derender.networks.encoders import IMAGE_SIZES, NetworkSettings
from derender.networks.factors import FACTORS
from derender.storage.bounded import first_line
from derender.storage.tensors import check_pickle, require_plain

NETS = {"netD": "geometry", "netA": "albedo", "netL": "light", "netV": "camera", "netC": "confidence"}
OPTIONAL = "netC"
MOST_UNKNOWN = 50  # kinds of objects in one file


class Empty:
    """Stands for an object that is not read: takes anything, does nothing."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __setstate__(self, _: Any) -> None:
        pass


def read_checkpoint(file: str | Path) -> tuple[NetworkSettings, dict[str, Tensor]]:
    """Sizes of the networks, and their tensors by the names that a `Derenderer`'s state has.

    No file is a FileNotFoundError; one that is no such checkpoint is a ValueError, which names what differs.
    """
    file = Path(file)
    if not file.exists():
        raise FileNotFoundError(f"{file} does not exist: give the .pth file that unsup3d wrote")
    content = _loaded(file)
    if not isinstance(content, Mapping):
        kind = type(content).__name__
        raise ValueError(f"{file} holds {kind}, no checkpoint of unsup3d: expected netD and others")
    theirs = {net: _tensors(content, net, file) for net in NETS}
    for net, tensors in theirs.items():
        if not tensors and net != OPTIONAL:
            holds = ", ".join(sorted(map(str, content))[:8]) or "nothing"
            raise ValueError(f"{file} is no checkpoint of unsup3d: it has no {net} (it holds {holds})")
    settings = _sizes(theirs, file)
    with torch.device("meta"):  # without memory
        ours: dict[str, nn.Module] = {factor.name: factor.build(settings) for factor in FACTORS}
        ours["confidence"] = ConfidenceNet(settings)
    weights: dict[str, Tensor] = {}
    for net, name in NETS.items():
        if theirs[net]:
            weights |= _renamed(theirs[net], ours[name], net, file)
    key = next(name for name in reversed(weights) if name.startswith("nets.light."))
    weights[key] = weights[key][[0, 1, 3, 2]]  # x is the tangent of yaw, y that of pitch
    return settings, weights


def _loaded(file: Path) -> Any:
    """What the file holds, with an empty object for whatever is neither tensor nor plain value."""
    check_pickle(file)
    with ExitStack() as known:
        known.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")  # of torch, about how a file was pickled
        for _ in range(MOST_UNKNOWN):
            try:
                return torch.load(file, map_location="cpu", weights_only=True)
            except pickle.UnpicklingError as error:
                unknown = re.search(r"Unsupported global: GLOBAL (\S+) was", str(error))
                if unknown is None:
                    what = "is damaged, no file of torch, or wants to run code when read: not opened"
                    raise ValueError(f"{file} {what}") from error
                name = unknown[1] if "." in unknown[1] else f"builtins.{unknown[1]}"
                known.enter_context(safe_globals([(Empty, name)]))
            except (RuntimeError, EOFError, ValueError, LookupError, TypeError, AttributeError) as error:
                why = f"is damaged or no file of torch ({first_line(error)}): download it again"
                raise ValueError(f"{file} {why}") from error
    raise ValueError(f"{file} holds more than {MOST_UNKNOWN} kinds of objects: no checkpoint of unsup3d")


def _tensors(content: Mapping[Any, Any], net: str, file: Path) -> dict[str, Tensor]:
    """The tensors of one net in their order, whether it is an entry of its own or a prefix."""
    entry = content.get(net)
    if not isinstance(entry, Mapping):
        entry = {name: value for name, value in content.items() if str(name).startswith(f"{net}.")}
    result = {str(name): value for name, value in entry.items() if isinstance(value, Tensor)}
    require_plain(result, file)
    return result


def _sizes(theirs: Mapping[str, Mapping[str, Tensor]], file: Path) -> NetworkSettings:
    """Read off the first and last convolutions of depth and light."""
    shapes = {net: [tuple(value.shape) for value in tensors.values()] for net, tensors in theirs.items()}
    light = shapes["netL"]
    try:
        sizes: dict[str, Any] = {"width": shapes["netD"][0][0], "light_width": light[0][0]}
        sizes |= {"code_size": light[-1][1], "image_size": 4 * 2 ** (len(light) - 2)}
        if shapes[OPTIONAL]:  # the first layer there that narrows is the one to the code
            narrowing = (one for one in shapes[OPTIONAL] if len(one) == 4 and one[0] < one[1])
            sizes["confidence_code_size"] = next(narrowing)[0]
        if sizes["image_size"] not in IMAGE_SIZES:
            raise ValueError(f"light has {len(light)} layers")
        return NetworkSettings(**sizes)
    except (IndexError, ValueError, StopIteration) as error:
        raise ValueError(f"{file} has other networks than unsup3d's ({error}): not imported") from error


def _renamed(theirs: Mapping[str, Tensor], module: nn.Module, net: str, file: Path) -> dict[str, Tensor]:
    """The n-th tensor of the file under the name of the network's n-th."""
    result: dict[str, Tensor] = {}
    expected, other = module.state_dict(), "this is another architecture"
    for (name, value), (ours, like) in zip(theirs.items(), expected.items(), strict=False):
        if value.shape not in (like.shape, (*like.shape, 1, 1)):
            expect = f"{tuple(like.shape)} is expected (derender's {ours}): {other}"
            raise ValueError(f"{file}: {net} has {name} of shape {tuple(value.shape)} where {expect}")
        if not bool(value.isfinite().all()):
            raise ValueError(f"{file}: {net} has {name} with NaN or infinite values: its training went wrong")
        result[f"nets.{NETS[net]}.{ours}"] = value.detach().reshape(like.shape).float()
    if len(theirs) != len(expected):
        raise ValueError(f"{file}: {net} has {len(theirs)} tensors, expected {len(expected)}: {other}")
    return result
