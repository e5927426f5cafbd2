"""Every baseline by name: one row each; nothing is imported until a row is used.

The class of a row holds the rest: its features, its losses and the settings of its run (model.py).
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derender.baselines.model import BaselineModel
    from derender.features import Embedded
    from derender.settings import Settings


@dataclass(frozen=True)
class Baseline:
    """One baseline; functions and classes are named as ``module.name`` in this package.

    Attributes:
        network: the class, where it has a network of its own that is saved in a folder.
        trainer: ``(config, images, out, ...) -> TrainResult``; empty where it is not trained here.
        opener: ``(name, source, image_size, seed) -> network``; empty where it has no network.
    """

    network: str = ""
    trainer: str = "training.train_in_loop"
    opener: str = "model.open_run"


BASELINES: Mapping[str, Baseline] = {
    "vqvae": Baseline("vqvae.Vqvae"),
    "simclr": Baseline("simclr.Simclr"),
    "ae": Baseline("autoencoder.Autoencoder"),
    "beta-vae": Baseline("autoencoder.BetaVae"),
    "resnet18": Baseline("supervised.Resnet18", trainer="supervised.train_supervised"),
    "stylegan2": Baseline("stylegan2.Stylegan"),
    "e4e": Baseline("e4e.E4e", opener="e4e.open_e4e"),
    "ris": Baseline("ris.Ris", trainer="ris_catalogue.train_ris"),
    "dinov2": Baseline(trainer="", opener="dinov2.open_dinov2"),
    "untrained": Baseline(trainer="", opener="controls.open_untrained"),
    **dict.fromkeys(("pixels", "pca", "hog", "noise"), Baseline(trainer="", opener="")),
}
TRAINED = tuple(name for name, row in BASELINES.items() if row.trainer)
CONTROLS = tuple(name for name, row in BASELINES.items() if not row.opener)
"""Those without a network: `controls.control_features` makes their tables."""


def row_of(name: str, among: Sequence[str] = tuple(BASELINES)) -> Baseline:
    """The row of that name; an unknown name is an error that suggests the closest."""
    from derender.data import suggestion

    if name not in among:
        raise ValueError(f"no baseline {name!r}{suggestion(name, among)}: choose one of {', '.join(among)}")
    return BASELINES[name]


def network_type(name: str) -> "type[BaselineModel]":
    """The class of a baseline that is trained here."""
    return _resolve(row_of(name, TRAINED).network)


def config_type(name: str) -> "type[Settings]":
    """The settings of a training run of a baseline."""
    return network_type(name).config_type


def train_baseline(config: Any, images: Any, out: Any, **how: Any) -> Any:
    """Train a baseline into a run folder, as its configuration (``baseline_config``) says.

    Args:
        config: settings; ``config.baseline`` is the name.
        images: an image set at the configured size.
        out: a new folder, or with ``resume=True`` that of an unfinished run.
        how: ``resume``, ``progress``, ``accelerator``, ``sample_sheet`` as for `derender.training.train`.

    Returns:
        The `TrainResult`.
    """
    return _resolve(row_of(config.baseline, TRAINED).trainer)(config, images, out, **how)


def open_baseline(
    name: str,
    source: str | None = None,
    *,
    device: str = "auto",
    features: Sequence[str] | None = None,
    image_size: int = 64,
    seed: int = 0,
) -> Any:
    """A network that embeds images.

    Args:
        name: of a baseline that has a network.
        source: its run folder; for e4e or its generator also a published .pt file; for dinov2 an id or a
            folder of weights (default: facebook/dinov2-small); for untrained the derender model to copy.
        device: "auto", "cpu" or "cuda".
        features: names of the features to compute; by default the baseline's first.
        image_size: side of the input images, where the network does not fix it (dinov2).
        seed: of the fresh weights of untrained.

    Raises:
        ValueError: unknown name or feature, no source where one is needed, or damaged weights.
        FileNotFoundError: there is no such source.
    """
    from derender.inputs import device_named

    opener = row_of(name).opener
    if not opener:
        raise ValueError(f"the baseline {name} has no network: its table comes from control_features")
    net = _resolve(opener)(name, source, image_size, seed)
    if features is not None:
        net.choose(tuple(features))
    return net.to(device_named(device))


def embed_baseline(
    name: str,
    images: Any,
    out: str | Path,
    source: str | None = None,
    *,
    features: Sequence[str] | None = None,
    image_size: int = 64,
    components: int = 64,
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[int, int], object] | None = None,
    reading: Mapping[str, Any] | None = None,
    **how: Any,
) -> "Embedded":
    """Write the feature table of a baseline or a control.

    Args:
        name: of the baseline.
        images: an address, or an image set.
        out: the parquet file.
        source, features, image_size, seed, device: see ``open_baseline``.
        components: numbers in pca and noise.
        reading: how an address is read: ``dataset``, ``part`` and ``limit``.
        how: further keywords of `derender.embed_to_file`, for baselines with a network.
        progress: called with (images done, images in all).
    """
    from derender.baselines.controls import control_features
    from derender.features import Embedded, embed_to_file

    if row_of(name).opener:
        net = open_baseline(name, source, device=device, features=features, image_size=image_size, seed=seed)
        origin = {"source": source, "baseline": name}
        return embed_to_file(images, net, out, **(reading or {}), origin=origin, progress=progress, **how)
    table = control_features(
        name, images, **(reading or {}), model=source, image_size=image_size, components=components,
        seed=seed, progress=progress,
    )  # fmt: skip
    table.write(out)
    widths = {factor: values.shape[1] for factor, values in table.factors.items()}
    facts = table.origin["data"], table.origin["layout"]
    origin = dict(table.origin)
    return Embedded(Path(out), len(table), widths, tuple(table.labels), origin, 0, (), 0, 0, *facts)


def _resolve(place: str) -> Any:
    module, _, name = place.rpartition(".")
    return getattr(importlib.import_module(f"derender.baselines.{module}"), name)
