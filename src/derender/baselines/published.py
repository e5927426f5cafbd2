"""Networks that others trained: a generator of stylegan2-pytorch, an encoder of encoder4editing, DINOv2.

Generator: ``g_ema`` of ``stylegan2-ffhq-config-f.pt``, or of any other that
https://github.com/rosinality/stylegan2-pytorch trains or converts. Encoder, generator and mean code:
``e4e_ffhq_encode.pt`` (https://github.com/omertov/encoder4editing, 1.2 GB). The tables below map our names to
theirs; sizes are read off the file, and the first key that does not fit is named. The files are pickles. They
are read with torch's reader for weights, which runs no code: a file that asks for any is refused.

DINOv2-small: Oquab et al., *DINOv2* (2023); weights facebook/dinov2-small (Apache-2.0), 22 million
parameters, learnt on 142 million images. They are read through transformers from the user's Hugging Face
cache or a folder, as safetensors only. Nothing is ever downloaded here.
"""

import pickle
import re
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from derender.baselines import model as base
from derender.baselines.e4e import E4e, E4eSettings
from derender.baselines.generator import FILTER, Generator, GeneratorSettings
from derender.storage.tensors import check_pickle, require_plain

GENERATOR_FILE = (
    "stylegan2-ffhq-config-f.pt (linked from the READMEs of https://github.com/rosinality/stylegan2-pytorch "
    "and of https://github.com/omertov/encoder4editing)"
)
E4E_FILE = "e4e_ffhq_encode.pt (linked from the README of https://github.com/omertov/encoder4editing)"
DAMAGED = (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, LookupError, AttributeError)
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
ENCODER_PARTS = {
    "shortcut": "shortcut_layer.0",
    "shortcut_norm": "shortcut_layer.1",
    "norm": "res_layer.0",
    "first": "res_layer.1",
    "active": "res_layer.2",
    "second": "res_layer.3",
    "last_norm": "res_layer.4",
    "squeeze": "res_layer.5.fc1",
    "excite": "res_layer.5.fc2",
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
            f"body.{sum(units[: int(m[1])]) + int(m[2])}.{ENCODER_PARTS[m[3]]}.{m[4]}"
        ),
        r"heads\.(\d+)\.convs\.(\d+)\.(\w+)": lambda m: f"styles.{m[1]}.convs.{2 * int(m[2])}.{m[3]}",
        r"heads\.(\d+)\.linear\.(\w+)": lambda m: f"styles.{m[1]}.linear.{m[2]}",
        r"(\w+)\.(\w+)": lambda m: f"{ENCODER_PARTS[m[1]]}.{m[2]}",
    }


def published_names(ours: Iterable[str], names: Names) -> dict[str, str]:
    """Our names, each with the published one."""
    return {one: next(name(m) for p, name in names.items() if (m := re.fullmatch(p, one))) for one in ours}


def load_published_generator(path: str | Path) -> Generator:
    """The averaged generator (``g_ema``) of a stylegan2-pytorch file, ready to use.

    A missing file is an error that says where to get it. A file that is damaged, needs code to be run, or is
    of another architecture is named with its first key that does not fit.
    """
    (weights,) = _parts(path, GENERATOR_FILE, "a generator of stylegan2-pytorch", "g_ema")
    with _architecture_of(path):
        net = Generator(generator_settings(_tensors(weights, "")))
        _fill(net, GENERATOR_NAMES, weights, "")
    return net.eval().requires_grad_(False)


def load_published_e4e(path: str | Path) -> E4e:
    """Encoder, generator and mean code of an encoder4editing file, ready to embed; errors as above."""
    weights, centre = _parts(path, E4E_FILE, "an encoder of encoder4editing", "state_dict", "latent_avg")
    with _architecture_of(path):
        decoder = generator_settings(_tensors(weights, "decoder."))
        settings = e4e_settings(_tensors(weights, "encoder."), decoder)
        model = E4e(settings)
        _fill(model.encoder, encoder_names(settings.units), weights, "encoder.")
        _fill(model.generator, GENERATOR_NAMES, weights, "decoder.")
        codes, size = model.centre.shape
        if not isinstance(centre, Tensor) or centre.numel() not in (size, codes * size):
            raise ValueError(f"'latent_avg' should have {size} or {codes} x {size} numbers")
        model.centre.copy_(centre.reshape(-1, size).expand_as(model.centre))
    return model.eval().requires_grad_(False)


@contextmanager
def _architecture_of(path: str | Path) -> Iterator[None]:
    """Build from a file: always the same noise maps, which a file may lack; what does not fit is named."""
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            yield
    except (LookupError, ValueError) as error:
        what = f"it has no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise ValueError(f"{path} is of another architecture: {what}") from error


def _parts(path: str | Path, wanted: str, kind: str, *names: str) -> list[Any]:
    """The entries of those names; the first is a mapping of tensors."""
    content = read_weights(path, wanted)
    for name in names:
        if name not in content:
            raise ValueError(f"{path} has no {name!r}, which {kind} has: {wanted}")
    weights = content[names[0]]
    if not isinstance(weights, Mapping) or not all(isinstance(v, Tensor) for v in weights.values()):
        raise ValueError(f"{path} holds no weights by name: train or fetch it again")
    require_plain(weights, Path(path))
    return [content[name] for name in names]


def read_weights(path: str | Path, wanted: str) -> Mapping[str, Any]:
    """The content of a pickle of weights; no code in it is run."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: nothing is downloaded here; get {wanted} and give its path")
    check_pickle(path)
    try:
        with torch.serialization.safe_globals([Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of unusual pickles: errors are raised below
            content = torch.load(path, map_location="cpu", weights_only=True)
    except DAMAGED as e:
        code = re.search(r"GLOBAL (\S+)", str(e))
        asked = code and f"wants to run code when it is read ({code[1]}): refused; get {wanted}"
        raise ValueError(f"{path} {asked or f'is damaged, or no file of torch: get {wanted} again'}") from e
    if not isinstance(content, Mapping):
        raise ValueError(f"{path} holds a {type(content).__name__} and no weights by name: get {wanted}")
    return content


def _tensors(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}


def generator_settings(tensors: Mapping[str, Tensor]) -> GeneratorSettings:
    """Sizes of a published generator; LookupError where a tensor or axis to read them from is missing."""
    steps = sum(f"to_rgbs.{number}.bias" in tensors for number in range(16))
    return GeneratorSettings(
        image_size=4 * 2**steps, style_size=tensors["style.1.weight"].shape[0],
        mapping_layers=sum(f"style.{number}.weight" in tensors for number in range(33)),
        channel_base=max(tensors[f"to_rgbs.{max(steps - 1, 0)}.conv.weight"].shape[2] * 4 * 2**steps, 32),
        channel_max=tensors["input.input"].shape[1],
    )  # fmt: skip


def e4e_settings(tensors: Mapping[str, Tensor], generator: GeneratorSettings) -> E4eSettings:
    """Sizes of a published encoder; every stage has a unit, so that one that is missing is named later."""
    width = tensors["input_layer.0.weight"].shape[0]
    widths = [len(value) for key, value in tensors.items() if key.endswith(".res_layer.3.weight")]
    halvings = sum(f"styles.0.convs.{number}.weight" in tensors for number in range(24))
    return E4eSettings.model_validate({
        "image_size": max(16 * 2**halvings, 32), "width": width, "generator": generator,
        "units": tuple(max(widths.count(factor * width), 1) for factor in (1, 2, 4, 8)),
        "reduction": max(width // max(tensors["body.0.res_layer.5.fc1.weight"].shape[0], 1), 1),
    })  # fmt: skip


def _fill(module: nn.Module, names: Names, weights: Mapping[str, Tensor], prefix: str) -> None:
    """Put the tensors of that prefix into a module of ours; the first that does not fit is named.

    Shapes are equal but for dimensions of 1. Noise maps may be missing. Filters are compared with ours.
    """
    state, there = module.state_dict(), _tensors(weights, prefix)
    taps = 2 * torch.tensor(FILTER)
    filters = {key: torch.outer(taps, taps) for key in there if key.endswith(".kernel")}
    expected = {key: state[ours] for ours, key in published_names(state, names).items()} | filters
    for key in dict.fromkeys([*expected, *there]):
        name = prefix + key
        if key not in expected:
            raise ValueError(f"it has {name!r}, which ours lacks")
        if key not in there:
            if key.startswith("noises."):
                continue
            raise ValueError(f"it has no {name!r}")
        value, found = expected[key], there[key]
        if found.squeeze().shape != value.squeeze().shape:
            shapes = f"{tuple(found.shape)}, expected {tuple(value.shape)} up to dimensions of 1"
            raise ValueError(f"{name!r} has shape {shapes}")
        if key in filters and not torch.allclose(found.float(), value, atol=1e-5):
            raise ValueError(f"{name!r} is not the filter [1, 3, 3, 1]")
        value.copy_(found.reshape(value.shape))


IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Dinov2Settings(base.BaselineSettings):
    """Which weights, and the side to which images are enlarged: a multiple of the patches' 14 pixels."""

    weights: str = "facebook/dinov2-small"
    enlarged: int = 224


class Dinov2(base.BaselineModel):
    """A vision transformer. Features: ``class`` (the class token) and ``patches`` (the mean patch)."""

    name, settings_type = "dinov2", Dinov2Settings
    features = ("class", "patches")
    settings: Dinov2Settings
    mean: Tensor
    std: Tensor

    def __init__(self, settings: Dinov2Settings, net: Any):
        super().__init__(settings)
        self.net = net
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def describe(self, images: base.Images) -> base.Features:
        side = self.settings.enlarged
        large = interpolate(images, (side, side), mode="bicubic", align_corners=False, antialias=True)
        tokens = self.net((large.clamp(0, 1) - self.mean) / self.std).last_hidden_state
        return {"class": tokens[:, 0], "patches": tokens[:, 1:].mean(dim=1)}

    @classmethod
    def open(
        cls, source: str | Path | None = None, *, image_size: int | None = None, seed: int = 0,
        enlarged: int = 224,
    ) -> "Dinov2":  # fmt: skip
        """The network with its published weights, ready to embed; ``seed`` is ignored.

        ``source`` is an id in the Hugging Face cache, or a folder with config.json and model.safetensors.
        Missing weights, a pickle, or another kind of network are a ValueError.
        """
        settings = Dinov2Settings(image_size=image_size or 64, enlarged=enlarged)
        if source is not None:
            settings = settings.model_copy(update={"weights": str(source)})
        source, folder = settings.weights, Path(settings.weights)
        if folder.suffix.lower() in base.PICKLES or (
            folder.is_dir() and not (folder / base.WEIGHTS_FILE).is_file()
        ):
            raise ValueError(  # an index of shards could name files outside the folder (CVE-2026-75104)
                f"{source} has no {base.WEIGHTS_FILE}: give a folder with config.json and the weights in "
                "that one file. Weights in parts, and pickles, which can run code, are not opened"
            )
        library = base.optional("transformers", "the baseline dinov2")
        try:
            tree, _ = library.PretrainedConfig.get_config_dict(source, local_files_only=True)
            if tree.get("model_type") != "dinov2":
                raise ValueError(f"{source} is a {tree.get('model_type')}, expected a dinov2")
            net, info = library.Dinov2Model.from_pretrained(
                source, local_files_only=True, use_safetensors=True, output_loading_info=True
            )
        except OSError as error:
            if folder.is_dir():
                raise ValueError(
                    f"{source} holds no config.json and {base.WEIGHTS_FILE} that can be read "
                    f"({str(error).splitlines()[0]})"
                ) from error
            raise ValueError(
                f"the weights {source} are not in the Hugging Face cache and nothing is downloaded here: run "
                f"'hf download {source}' once where there is a network, or name their folder"
            ) from error
        if missing := sorted(info["missing_keys"]):
            raise ValueError(f"{source} is of another architecture: it has no {missing[0]!r}")
        return cls(settings, net).eval().requires_grad_(False)
