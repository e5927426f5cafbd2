"""Controls that every table carries: raw pixels, PCA, an untrained encoder, and noise.

A learned feature that does not beat these has learned nothing worth telling. On 1,000 labels of CelebA, PCA
reaches a balanced accuracy of 0.674 and an untrained encoder 0.662 (SPEC.md), so the bar is not low.
"""

from typing import Any

import numpy as np
import torch
from sklearn.decomposition import PCA

from derender.data import PictureSet
from derender.features import FeatureTable, Progress, embed_pictures, table_labels


def pixel_features(pictures: PictureSet) -> FeatureTable:
    """Pixels themselves, in 0..1, flattened: factor ``pixels``."""
    return control_table(pictures, "pixels", _flat(pictures), {"control": "pixels"})


def pca_features(
    pictures: PictureSet,
    *,
    components: int = 64,
    whiten: bool = True,
    fit_on: PictureSet | None = None,
    seed: int = 0,
) -> FeatureTable:
    """Principal components of the pixels: factor ``pca``.

    Args:
        pictures: what to describe.
        components: how many.
        whiten: scale every component to variance 1.
        fit_on: pictures that give the components; by default ``pictures`` themselves.
        seed: of the randomised solver.
    """
    source = pictures if fit_on is None else fit_on
    limit = min(len(source), int(np.prod(source.images.shape[1:])))
    if not 1 <= components <= limit:
        raise ValueError(
            f"{components} components cannot be had from {len(source)} pictures: ask for 1 to {limit}"
        )
    if source.images.shape[1:] != pictures.images.shape[1:]:
        raise ValueError(
            f"PCA fitted on pictures {source.images.shape[1:]} does not take {pictures.images.shape[1:]}: "
            "read both at one size"
        )
    pca = PCA(components, whiten=whiten, random_state=seed).fit(_flat(source))
    origin = {
        "control": "pca",
        "components": components,
        "whiten": whiten,
        "fitted_on": len(source),
        "seed": seed,
    }
    return control_table(pictures, "pca", pca.transform(_flat(pictures)), origin)


def untrained_twin(model: Any, seed: int) -> Any:
    """The same settings, factors and renderer with fresh weights; torch's global generator is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return type(model)(model.settings, model.factors, model.renderer).to(model.device).eval()


def untrained_features(
    model: Any,
    pictures: PictureSet,
    *,
    seed: int = 0,
    batch_size: int = 256,
    progress: Progress | None = None,
) -> FeatureTable:
    """Features of the same architecture with fresh weights: the model's own factors."""
    twin = untrained_twin(model, seed)
    origin = {"control": "untrained", "seed": seed}
    return embed_pictures(twin, pictures, batch_size=batch_size, progress=progress, origin=origin)


def noise_features(pictures: PictureSet, *, dimensions: int = 64, seed: int = 0) -> FeatureTable:
    """Normal noise that knows nothing of the pictures, factor ``noise``: the chance level of any protocol."""
    noise = np.random.default_rng(seed).standard_normal((len(pictures), dimensions))
    return control_table(pictures, "noise", noise, {"control": "noise", "seed": seed})


def _flat(pictures: PictureSet) -> np.ndarray:
    return np.asarray(pictures.images, np.float32).reshape(len(pictures), -1) / 255


def control_table(
    pictures: PictureSet, name: str, values: np.ndarray, origin: dict[str, Any]
) -> FeatureTable:
    """One factor (N, D) as a table, with the pictures' names and labels; ``origin`` says what made it."""
    origin = {"data": pictures.source, "layout": pictures.layout, **origin}
    return FeatureTable(pictures.files, {name: values.astype(np.float32)}, table_labels(pictures), origin)
