"""Other ways to make a feature table, for comparison: networks that are trained here or by others, controls.

Everything is imported on first use. The class of a network holds its features, losses and settings
(model.py).
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derender import on_first_use

if TYPE_CHECKING:
    from derender.features import Embedded

NETWORKS: Mapping[str, str] = {  # classes of those with a network, as ``module.name`` in this package
    "vqvae": "autoencoders.Vqvae",
    "simclr": "simclr.Simclr",
    "ae": "autoencoders.Autoencoder",
    "beta-vae": "autoencoders.BetaVae",
    "resnet18": "supervised.Resnet18",
    "stylegan2": "stylegan2.Stylegan",
    "e4e": "e4e.E4e",
    "ris": "ris.Ris",
    "dinov2": "dinov2.Dinov2",
    "untrained": "controls.Untrained",
}
CONTROLS = ("pixels", "pca", "gradientfaces", "hog", "lbp", "noise")  # without a network (`control_features`)
BASELINES = (*NETWORKS, *CONTROLS)
TRAINED = tuple(name for name in NETWORKS if name not in ("dinov2", "untrained"))
_HOME = {
    "control_features": "controls", "baseline_config": "model", "image_size_of": "model",
    "load_baseline": "model", "read_any_config": "model", "stored_config": "model",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    return on_first_use(__name__, _HOME, name)


def network_type(name: str, among: Sequence[str] = TRAINED) -> Any:
    """The class of a baseline that is trained here; an unknown name is an error that suggests the closest."""
    from derender.storage.places import require_known

    require_known("baseline", name, among)
    if name in CONTROLS:
        raise ValueError(f"the baseline {name} has no network: its table comes from control_features")
    module, _, kind = NETWORKS[name].partition(".")
    return getattr(importlib.import_module(f"derender.baselines.{module}"), kind)


def train_baseline(config: Any, images: Any, out: Any, **how: Any) -> Any:
    """Train a baseline into a run folder, as its configuration (``baseline_config``) says.

    ``images`` are an image set at the configured size, ``out`` is a new folder; ``resume``, ``progress``,
    ``accelerator``, ``sample_sheet`` and the `TrainResult` are those of `derender.training.train`.
    """
    net = network_type(config.baseline)
    try:
        return net.train_into(config, images, out, **how)
    except KeyboardInterrupt as stop:
        if str(stop) or hasattr(net, "losses") or not Path(out).exists():  # of the loop, which resumes
            raise
        note = "has settings and losses but no model: train again into another folder"
        raise KeyboardInterrupt(f"stopped by Ctrl-C; {out} {note}") from None


def open_baseline(
    name: str, source: str | None = None, *, device: str = "auto", features: Sequence[str] | None = None,
    image_size: int | None = None, seed: int = 0,
) -> Any:  # fmt: skip
    """A network that embeds images.

    Args:
        name: of a baseline that has a network.
        source: its run folder; for dinov2 an id or a folder of weights
            (default: facebook/dinov2-small); for untrained the derender model to copy.
        device: "auto", "cpu" or "cuda".
        features: names of the features to compute; by default the baseline's first.
        image_size: side of the input images, where the network does not fix it (dinov2; default 64); e4e
            enlarges smaller ones to its own.
        seed: of the fresh weights of untrained.
    """
    from derender.inputs import device_named

    net = network_type(name, BASELINES).open(source, image_size=image_size, seed=seed)
    if features is not None:
        net.choose(tuple(features))
    return net.to(device_named(device))


def embed_baseline(
    name: str, images: Any, out: str | Path, source: str | None = None, *,
    features: Sequence[str] | None = None, image_size: int | None = None, components: int = 64, seed: int = 0,
    device: str = "auto", progress: Callable[[int, int], object] | None = None, **how: Any,
) -> "Embedded":  # fmt: skip
    """Write the feature table of a baseline or a control to the parquet file ``out``.

    Arguments are ``open_baseline``'s and those of `derender.embed_to_file`, of which a control takes how
    images are read. ``components`` is the number of dimensions of pca and noise.
    """
    from derender.baselines.controls import control_features
    from derender.features.embedding import LISTED_SKIPPED, Embedded, embed_to_file
    from derender.inputs import as_images

    if name not in CONTROLS:
        net = open_baseline(name, source, device=device, features=features, image_size=image_size, seed=seed)
        origin = {"source": source, "baseline": name}
        return embed_to_file(images, net, out, origin=origin, progress=progress, **how)
    if how.get("engine") == "ray":
        raise ValueError(f"engine 'ray' is for networks, and {name} has none: leave it out")
    part, kept = how.get("part", "all"), how.get("keep_duplicates", False)
    reading = {"dataset": how.get("dataset", "auto"), "limit": how.get("limit")}
    images = as_images(images, image_size or 64, **reading, keep_duplicates=kept)
    table = control_features(name, images, part, source, components=components, seed=seed, progress=progress)
    widths, origin = {name: table.factors[name].shape[1]}, {**table.origin}
    origin |= {} if part == "all" else {"part": part}
    replace(table, origin=origin).write(out)
    counts = len(images.skipped), images.skipped[:LISTED_SKIPPED], len(images.duplicates), 0
    of = origin["data"], origin["layout"]
    return Embedded(Path(out), len(table), widths, tuple(table.labels), origin, *counts, *of, kept)
