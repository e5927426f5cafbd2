"""Reads the published networks: a generator of stylegan2-pytorch, an encoder of encoder4editing.

Files: ``stylegan2-ffhq-config-f.pt`` (or any generator that https://github.com/rosinality/stylegan2-pytorch
trains or converts; its ``g_ema``), and ``e4e_ffhq_encode.pt`` (https://github.com/omertov/encoder4editing,
"FFHQ Inversion" in its README, 1.2 GB; encoder, generator and mean code). Every key is mapped by name and
every shape held against the architecture, whose sizes are read off the file; what does not fit is named.
The files are pickles. They are read with torch's reader for weights, which runs no code: what asks for any is
refused. Leaves out discriminators and optimisers that may lie beside.
"""

import pickle
import re
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import log2
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from derender.baselines.stylegan2.e4e import E4e, E4eSettings
from derender.baselines.stylegan2.generator import Generator, GeneratorSettings, style_layers
from derender.baselines.stylegan2.layers import FILTER
from derender.storage.tensors import refuse_old_torch

GENERATOR_FILE = (
    "stylegan2-ffhq-config-f.pt (linked from the READMEs of https://github.com/rosinality/stylegan2-pytorch "
    "and of https://github.com/omertov/encoder4editing)"
)
Built = TypeVar("Built")
E4E_FILE = "e4e_ffhq_encode.pt (linked from the README of https://github.com/omertov/encoder4editing)"


@dataclass(frozen=True)
class Entry:
    """One tensor of a published file.

    Attributes:
        key: its name there.
        shape: its shape there.
        name: the tensor of ours that it becomes, reshaped; None for a filter, which is only compared.
        optional: whether files without it are in use (noise maps, which early files lack).
    """

    key: str
    shape: tuple[int, ...]
    name: str | None
    optional: bool = False


def generator_entries(settings: GeneratorSettings) -> Iterator[Entry]:
    """What stylegan2-pytorch calls the tensors of a generator of this size, in the order it has them."""
    size = settings.style_size
    for layer in range(settings.mapping_layers):
        for kind, shape in (("weight", (size, size)), ("bias", (size,))):
            yield Entry(f"style.{layer + 1}.{kind}", shape, f"mapping.layers.{layer}.{kind}")
    yield Entry("input.input", (1, settings.channels(4), 4, 4), "constant")
    for layer in style_layers(settings):
        kind, index = ("to_rgb", layer.index) if layer.colour else ("conv", layer.index)
        there = f"{kind}1" if index == 0 else f"{kind}s.{index - 1}"
        here, inputs = f"{kind}s.{index}", layer.channels
        enlarges = not layer.colour and index % 2 == 1
        side, kernel = (layer.resolution * (2 if enlarges else 1), 1 if layer.colour else 3)
        outputs = 3 if layer.colour else settings.channels(side)
        if layer.colour:
            yield Entry(f"{there}.bias", (1, 3, 1, 1), f"{here}.bias")
            if index:
                yield Entry(f"{there}.upsample.kernel", (4, 4), None)
        yield Entry(f"{there}.conv.weight", (1, outputs, inputs, kernel, kernel), f"{here}.weight")
        if enlarges:
            yield Entry(f"{there}.conv.blur.kernel", (4, 4), None)
        yield Entry(f"{there}.conv.modulation.weight", (inputs, size), f"{here}.affine.weight")
        yield Entry(f"{there}.conv.modulation.bias", (inputs,), f"{here}.affine.bias")
        if not layer.colour:
            yield Entry(f"{there}.noise.weight", (1,), f"{here}.noise_strength")
            yield Entry(f"{there}.activate.bias", (outputs,), f"{here}.bias")
    for index in range(settings.codes - 1):
        side = 2 ** ((index + 5) // 2)
        yield Entry(f"noises.noise_{index}", (1, 1, side, side), f"noise_{index}", optional=True)


def encoder_entries(settings: E4eSettings) -> Iterator[Entry]:
    """What encoder4editing calls the tensors of its encoder."""
    width = settings.width
    widths = (width, width, 2 * width, 4 * width, 8 * width)
    yield Entry("input_layer.0.weight", (width, 3, 3, 3), "stem.weight")
    yield from _norm("input_layer.1", "stem_norm", width)
    yield Entry("input_layer.2.weight", (width,), "stem_active.weight")
    number = 0
    for stage, count in enumerate(settings.units):
        for unit in range(count):
            before, after = widths[stage if unit == 0 else stage + 1], widths[stage + 1]
            yield from _unit(
                f"body.{number}", f"stages.{stage}.{unit}", before, after, after // settings.reduction
            )
            number += 1
    size, deepest = settings.generator.style_size, widths[4]
    for code in range(settings.generator.codes):
        stride = 16 if code < 3 else 8 if code < 7 else 4
        for pool in range(int(log2(settings.image_size // stride))):
            there, here = f"styles.{code}.convs.{2 * pool}", f"heads.{code}.convs.{pool}"
            yield Entry(f"{there}.weight", (size, deepest if pool == 0 else size, 3, 3), f"{here}.weight")
            yield Entry(f"{there}.bias", (size,), f"{here}.bias")
        yield Entry(f"styles.{code}.linear.weight", (size, size), f"heads.{code}.linear.weight")
        yield Entry(f"styles.{code}.linear.bias", (size,), f"heads.{code}.linear.bias")
    for there, here, inputs in (("latlayer1", "to_middle", widths[3]), ("latlayer2", "to_fine", widths[2])):
        yield Entry(f"{there}.weight", (deepest, inputs, 1, 1), f"{here}.weight")
        yield Entry(f"{there}.bias", (deepest,), f"{here}.bias")


def _unit(there: str, here: str, before: int, after: int, narrow: int) -> Iterator[Entry]:
    if before != after:
        shape = (after, before, 1, 1)
        yield Entry(f"{there}.shortcut_layer.0.weight", shape, f"{here}.shortcut.weight")
        yield from _norm(f"{there}.shortcut_layer.1", f"{here}.shortcut_norm", after)
    there = f"{there}.res_layer"
    yield from _norm(f"{there}.0", f"{here}.norm", before)
    yield Entry(f"{there}.1.weight", (after, before, 3, 3), f"{here}.first.weight")
    yield Entry(f"{there}.2.weight", (after,), f"{here}.active.weight")
    yield Entry(f"{there}.3.weight", (after, after, 3, 3), f"{here}.second.weight")
    yield from _norm(f"{there}.4", f"{here}.last_norm", after)
    yield Entry(f"{there}.5.fc1.weight", (narrow, after, 1, 1), f"{here}.squeeze.weight")
    yield Entry(f"{there}.5.fc2.weight", (after, narrow, 1, 1), f"{here}.excite.weight")


def _norm(there: str, here: str, width: int) -> Iterator[Entry]:
    for part in ("weight", "bias", "running_mean", "running_var"):
        yield Entry(f"{there}.{part}", (width,), f"{here}.{part}")
    yield Entry(f"{there}.num_batches_tracked", (), f"{here}.num_batches_tracked")


def load_published_generator(path: str | Path) -> Generator:
    """The averaged generator (``g_ema``) of a stylegan2-pytorch file, ready to use.

    Raises:
        FileNotFoundError: there is no such file; says where it is to be had.
        ValueError: it is damaged, wants to run code, or is of another architecture (names the first key).
    """
    content = read_weights(path, GENERATOR_FILE)
    if "g_ema" not in content:
        raise ValueError(
            f"{path} has no 'g_ema', which a generator of stylegan2-pytorch has: {GENERATOR_FILE}"
        )
    weights = _tensors(content["g_ema"], path)
    settings = _generator_settings(weights, path, "")
    generator = _seeded(lambda: Generator(settings))
    _fit(generator, weights, generator_entries(settings), path, "")
    return generator.eval().requires_grad_(False)


def load_published_e4e(path: str | Path) -> E4e:
    """Encoder, generator and mean code of an encoder4editing file, ready to embed.

    Raises:
        FileNotFoundError: there is no such file; says where it is to be had.
        ValueError: it is damaged, wants to run code, or is of another architecture (names the first key).
    """
    content = read_weights(path, E4E_FILE)
    for part in ("state_dict", "latent_avg"):
        if part not in content:
            raise ValueError(f"{path} has no {part!r}, which an encoder of encoder4editing has: {E4E_FILE}")
    weights = _tensors(content["state_dict"], path)
    encoder = {key[8:]: value for key, value in weights.items() if key.startswith("encoder.")}
    decoder = {key[8:]: value for key, value in weights.items() if key.startswith("decoder.")}
    settings = _e4e_settings(encoder, _generator_settings(decoder, path, "decoder."), path)
    model = _seeded(lambda: E4e(settings))
    _fit(model.encoder, encoder, encoder_entries(settings), path, "encoder.")
    _fit(model.generator, decoder, generator_entries(settings.generator), path, "decoder.")
    centre, size = content["latent_avg"], settings.generator.style_size
    if not isinstance(centre, Tensor) or centre.numel() not in (size, model.centre.numel()):
        raise ValueError(f"{path}: 'latent_avg' should have {size} or {tuple(model.centre.shape)} numbers")
    model.centre.copy_(centre.reshape(-1, size).expand_as(model.centre))
    return model.eval().requires_grad_(False)


def _seeded(build: Callable[[], Built]) -> Built:
    """What is built, with the noise maps that a file may lack drawn alike every time."""
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
            warnings.simplefilter("ignore", UserWarning)  # of unusual pickles: what is wrong is said below
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        asked = re.search(r"GLOBAL (\S+)", str(error))
        if asked is None:
            raise ValueError(f"{path} is damaged, or no file of torch: get {wanted} again") from error
        raise ValueError(
            f"{path} wants to run code when it is read ({asked[1]}): refused; get {wanted}"
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, IndexError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path} is damaged ({reason}): get {wanted} again") from error
    if not isinstance(content, Mapping):
        raise ValueError(f"{path} holds a {type(content).__name__} and no weights by name: get {wanted}")
    return content


def _tensors(weights: Any, path: str | Path) -> dict[str, Tensor]:
    if not isinstance(weights, Mapping) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise ValueError(f"{path} holds no weights by name: train or fetch it again")
    return dict(weights)


def _shape(weights: Mapping[str, Tensor], key: str, dimensions: int, path: Any, prefix: str) -> torch.Size:
    if key not in weights:
        raise ValueError(f"{path} has no {prefix + key!r}, which this architecture needs")
    if weights[key].ndim != dimensions:
        found = tuple(weights[key].shape)
        raise ValueError(f"{path}: {prefix + key!r} has shape {found}, expected {dimensions} dimensions")
    return weights[key].shape


def _generator_settings(weights: Mapping[str, Tensor], path: Any, prefix: str) -> GeneratorSettings:
    """Sizes of a generator as its file tells them; what is inconsistent shows when it is fitted."""
    size = _shape(weights, "style.1.weight", 2, path, prefix)[0]
    widest = _shape(weights, "input.input", 4, path, prefix)[1]
    steps = sum(f"to_rgbs.{index}.bias" in weights for index in range(16))
    last = f"to_rgbs.{steps - 1}.conv.weight" if steps else "to_rgbs.0.conv.weight"
    side = 4 * 2**steps
    narrowest = _shape(weights, last, 5, path, prefix)[2]
    return GeneratorSettings(
        image_size=side,
        style_size=size,
        mapping_layers=sum(f"style.{layer}.weight" in weights for layer in range(1, 33)),
        channel_base=max(narrowest * side, 32),
        channel_max=widest,
    )


def _e4e_settings(weights: Mapping[str, Tensor], generator: GeneratorSettings, path: Any) -> E4eSettings:
    width = _shape(weights, "input_layer.0.weight", 4, path, "encoder.")[0]
    outputs = []
    while (key := f"body.{len(outputs)}.res_layer.3.weight") in weights:
        outputs.append(_shape(weights, key, 4, path, "encoder.")[0])
    units = _stages(outputs, width)
    narrow = _shape(weights, "body.0.res_layer.5.fc1.weight", 4, path, "encoder.")[0]
    pools = sum(f"styles.0.convs.{2 * pool}.weight" in weights for pool in range(12))
    return E4eSettings(
        image_size=max(16 * 2**pools, 32),
        width=width,
        units=units,
        reduction=max(width // max(narrow, 1), 1),
        generator=generator,
    )


def _stages(outputs: list[int], width: int) -> tuple[int, int, int, int]:
    """How many units have each width; at least one, so that a missing one is named when it is fitted."""
    first, second, third, fourth = (max(outputs.count(factor * width), 1) for factor in (1, 2, 4, 8))
    return first, second, third, fourth


def _fit(
    module: torch.nn.Module, weights: dict[str, Tensor], entries: Iterator[Entry], path: Any, prefix: str
) -> None:
    """Put a file's tensors into a module of ours; the first that does not fit is named."""
    state, taps = module.state_dict(), 2 * torch.tensor(FILTER)
    for entry in entries:
        key = prefix + entry.key
        if entry.key not in weights:
            if entry.optional:
                continue
            raise ValueError(f"{path} is of another architecture: it has no {key!r}")
        value = weights.pop(entry.key)
        if tuple(value.shape) != entry.shape:
            raise ValueError(
                f"{path} is of another architecture: {key!r} has shape {tuple(value.shape)}, expected "
                f"{entry.shape}"
            )
        if entry.name is None:
            if not torch.allclose(value.float(), torch.outer(taps, taps), atol=1e-5):
                raise ValueError(f"{path} is of another architecture: {key!r} is not the filter [1, 3, 3, 1]")
            continue
        state[entry.name] = value.reshape(state[entry.name].shape).to(state[entry.name].dtype)
    if weights:
        raise ValueError(
            f"{path} is of another architecture: it has {prefix + next(iter(weights))!r}, which ours lacks"
        )
    module.load_state_dict(state)
