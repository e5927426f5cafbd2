"""Reads the published networks: a generator of stylegan2-pytorch, an encoder of encoder4editing.

Files: ``stylegan2-ffhq-config-f.pt`` (or any generator that https://github.com/rosinality/stylegan2-pytorch
trains or converts; its ``g_ema``), and ``e4e_ffhq_encode.pt`` (https://github.com/omertov/encoder4editing,
"FFHQ Inversion" in its README, 1.2 GB; encoder, generator and mean code). The tables below map our names to
theirs; sizes are read off the file, and the first key that does not fit is named. The files are pickles. They
are read with torch's reader for weights, which runs no code: a file that asks for any is refused. Leaves out
discriminators and optimisers that may be stored beside.
"""

import pickle
import re
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from derender.baselines.e4e import E4e, E4eSettings
from derender.baselines.stylegan2_generator import FILTER, Generator, GeneratorSettings
from derender.storage.tensors import refuse_old_torch

GENERATOR_FILE = (
    "stylegan2-ffhq-config-f.pt (linked from the READMEs of https://github.com/rosinality/stylegan2-pytorch "
    "and of https://github.com/omertov/encoder4editing)"
)
E4E_FILE = "e4e_ffhq_encode.pt (linked from the README of https://github.com/omertov/encoder4editing)"
Built = TypeVar("Built", bound=nn.Module)
Names = Mapping[str, Callable[[re.Match[str]], str]]
"""Patterns of our names, and how to write the published name of a tensor that matches."""

LAYER = {"weight": "conv.weight", "affine": "conv.modulation", "noise_strength": "noise.weight"}
GENERATOR_NAMES: Names = {
    r"mapping\.layers\.(\d+)\.(\w+)": lambda m: f"style.{int(m[1]) + 1}.{m[2]}",
    r"constant": lambda m: "input.input",
    r"noise_(\d+)": lambda m: f"noises.noise_{m[1]}",
    r"(conv|to_rgb)s\.(\d+)\.(\w+)(.*)": lambda m: (
        (f"{m[1]}s.{int(m[2]) - 1}." if int(m[2]) else f"{m[1]}1.")
        + (LAYER | {"bias": "activate.bias" if m[1] == "conv" else "bias"})[m[3]]
        + m[4]
    ),
}
"""Our generator and stylegan2-pytorch."""
UNIT = {
    "shortcut": "shortcut_layer.0",
    "shortcut_norm": "shortcut_layer.1",
    "norm": "res_layer.0",
    "first": "res_layer.1",
    "active": "res_layer.2",
    "second": "res_layer.3",
    "last_norm": "res_layer.4",
    "squeeze": "res_layer.5.fc1",
    "excite": "res_layer.5.fc2",
}
OUTSIDE = {
    "stem": "input_layer.0",
    "stem_norm": "input_layer.1",
    "stem_active": "input_layer.2",
    "to_middle": "latlayer1",
    "to_fine": "latlayer2",
}


def encoder_names(units: Sequence[int]) -> Names:
    """Our encoder with so many units in each stage, and encoder4editing."""
    return {
        r"stages\.(\d)\.(\d+)\.(\w+)\.(.*)": lambda m: (
            f"body.{sum(units[: int(m[1])]) + int(m[2])}.{UNIT[m[3]]}.{m[4]}"
        ),
        r"heads\.(\d+)\.convs\.(\d+)\.(\w+)": lambda m: f"styles.{m[1]}.convs.{2 * int(m[2])}.{m[3]}",
        r"heads\.(\d+)\.linear\.(\w+)": lambda m: f"styles.{m[1]}.linear.{m[2]}",
        r"(\w+)\.(\w+)": lambda m: f"{OUTSIDE[m[1]]}.{m[2]}",
    }


def published_names(ours: Iterable[str], names: Names) -> dict[str, str]:
    """Our names, each with the published one."""
    return {one: next(name(m) for p, name in names.items() if (m := re.fullmatch(p, one))) for one in ours}


def load_published_generator(path: str | Path) -> Generator:
    """The averaged generator (``g_ema``) of a stylegan2-pytorch file, ready to use.

    Raises:
        FileNotFoundError: there is no such file; says where to get it.
        ValueError: it is damaged, needs code to be run, or is of another architecture (names the first key).
    """
    content = read_weights(path, GENERATOR_FILE)
    if "g_ema" not in content:
        raise ValueError(
            f"{path} has no 'g_ema', which a generator of stylegan2-pytorch has: {GENERATOR_FILE}"
        )
    there = Weights(content["g_ema"], path)
    settings = there.generator_settings()
    generator = _seeded(lambda: Generator(settings))
    there.fill(generator, GENERATOR_NAMES)
    return generator.eval().requires_grad_(False)


def load_published_e4e(path: str | Path) -> E4e:
    """Encoder, generator and mean code of an encoder4editing file, ready to embed.

    Raises:
        FileNotFoundError: there is no such file; says where to get it.
        ValueError: it is damaged, needs code to be run, or is of another architecture (names the first key).
    """
    content = read_weights(path, E4E_FILE)
    for part in ("state_dict", "latent_avg"):
        if part not in content:
            raise ValueError(f"{path} has no {part!r}, which an encoder of encoder4editing has: {E4E_FILE}")
    encoder, decoder = (Weights(content["state_dict"], path, part) for part in ("encoder.", "decoder."))
    settings = encoder.e4e_settings(decoder.generator_settings())
    model = _seeded(lambda: E4e(settings))
    encoder.fill(model.encoder, encoder_names(settings.units))
    decoder.fill(model.generator, GENERATOR_NAMES)
    centre, size = content["latent_avg"], settings.generator.style_size
    if not isinstance(centre, Tensor) or centre.numel() not in (size, model.centre.numel()):
        raise ValueError(f"{path}: 'latent_avg' should have {size} or {tuple(model.centre.shape)} numbers")
    model.centre.copy_(centre.reshape(-1, size).expand_as(model.centre))
    return model.eval().requires_grad_(False)


def _seeded(build: Callable[[], Built]) -> Built:
    """The same noise maps every time, which a file may lack."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return build()


def read_weights(path: str | Path, wanted: str) -> Mapping[str, Any]:
    """The content of a pickle of weights; no code in it is run."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: nothing is downloaded here; get {wanted} and give its path")
    refuse_old_torch(path)
    try:
        with torch.serialization.safe_globals([Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of unusual pickles: errors are raised below
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        code = re.search(r"GLOBAL (\S+)", str(error))
        if code is None:
            raise ValueError(f"{path} is damaged, or no file of torch: get {wanted} again") from error
        raise ValueError(
            f"{path} wants to run code when it is read ({code[1]}): refused; get {wanted}"
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, IndexError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path} is damaged ({reason}): get {wanted} again") from error
    if not isinstance(content, Mapping):
        raise ValueError(f"{path} holds a {type(content).__name__} and no weights by name: get {wanted}")
    return content


class Weights:
    """The tensors of a published file whose names begin with ``prefix``, by the rest of their names."""

    def __init__(self, content: Any, path: str | Path, prefix: str = ""):
        if not isinstance(content, Mapping) or not all(isinstance(v, Tensor) for v in content.values()):
            raise ValueError(f"{path} holds no weights by name: train or fetch it again")
        self.path, self.prefix = path, prefix
        self.tensors = {k.removeprefix(prefix): v for k, v in content.items() if k.startswith(prefix)}

    def shape(self, key: str, dimensions: int) -> torch.Size:
        """The shape of a tensor that has to be in the file."""
        if key not in self.tensors:
            raise ValueError(f"{self.path} has no {self.prefix + key!r}, which this architecture needs")
        shape = self.tensors[key].shape
        if len(shape) != dimensions:
            raise ValueError(
                f"{self.path}: {self.prefix + key!r} has shape {tuple(shape)}, expected {dimensions} axes"
            )
        return shape

    def count(self, key: str, most: int) -> int:
        """How many of the keys ``key.format(0)``, ``key.format(1)``, ... are in the file."""
        return sum(key.format(number) in self.tensors for number in range(most))

    def generator_settings(self) -> GeneratorSettings:
        """Sizes of a generator; an inconsistency shows when the module is filled."""
        steps = self.count("to_rgbs.{}.bias", 16)
        side = 4 * 2**steps
        size = self.shape("style.1.weight", 2)[0]
        widest = self.shape("input.input", 4)[1]
        narrowest = self.shape(f"to_rgbs.{max(steps - 1, 0)}.conv.weight", 5)[2]
        return GeneratorSettings(
            image_size=side,
            style_size=size,
            mapping_layers=self.count("style.{}.weight", 33),
            channel_base=max(narrowest * side, 32),
            channel_max=widest,
        )

    def e4e_settings(self, generator: GeneratorSettings) -> E4eSettings:
        """Sizes of an encoder; every stage has at least one unit, so that a missing one is named later."""
        width = self.shape("input_layer.0.weight", 4)[0]
        units = [
            self.shape(f"body.{number}.res_layer.3.weight", 4)[0]
            for number in range(self.count("body.{}.res_layer.3.weight", 1_000))
        ]
        narrow = self.shape("body.0.res_layer.5.fc1.weight", 4)[0]
        return E4eSettings(
            image_size=max(16 * 2 ** self.count("styles.0.convs.{}.weight", 24), 32),
            width=width,
            units=tuple(max(units.count(factor * width), 1) for factor in (1, 2, 4, 8)),  # pyright: ignore
            reduction=max(width // max(narrow, 1), 1),
            generator=generator,
        )

    def fill(self, module: nn.Module, names: Names) -> None:
        """Put the tensors into a module of ours; the first that does not fit is named.

        Shapes are equal but for dimensions of 1. Noise maps may be missing. Filters are compared with ours.
        """
        state, left = module.state_dict(), dict(self.tensors)
        other = f"{self.path} is of another architecture"
        for ours, key in published_names(state, names).items():
            value = state[ours]
            if key not in left:
                if key.startswith("noises."):
                    continue
                raise ValueError(f"{other}: it has no {self.prefix + key!r}")
            stored = left.pop(key)
            shapes = [[size for size in tensor.shape if size != 1] for tensor in (stored, value)]
            if shapes[0] != shapes[1]:
                raise ValueError(
                    f"{other}: {self.prefix + key!r} has shape {tuple(stored.shape)}, expected "
                    f"{tuple(value.shape)} up to dimensions of 1"
                )
            state[ours] = stored.reshape(value.shape).to(value.dtype)
        for key, value in left.items():
            if not key.endswith(".kernel"):
                raise ValueError(f"{other}: it has {self.prefix + key!r}, which ours lacks")
            if value.shape != (4, 4) or not torch.allclose(value.float(), _filter(), atol=1e-5):
                raise ValueError(f"{other}: {self.prefix + key!r} is not the filter [1, 3, 3, 1]")
        module.load_state_dict(state)


def _filter() -> Tensor:
    taps = 2 * torch.tensor(FILTER)
    return torch.outer(taps, taps)
