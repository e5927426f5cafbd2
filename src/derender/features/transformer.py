"""DisentangledFeatures: a trained model as a step of a scikit-learn pipeline."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sklearn.base import BaseEstimator, TransformerMixin

import derender
from derender.data import read_image
from derender.data.image import refuse_values
from derender.features.extract import embed_images
from derender.features.table import chosen


class DisentangledFeatures(TransformerMixin, BaseEstimator):
    """scikit-learn transformer: images in, features of the chosen factors out.

    Images are a sequence of paths (read and resized) or an array at the model's size: (N, 3, H, W) or (N, H,
    W, 3), uint8 or float in 0..1. Nothing is learned in ``fit``; the model is loaded on first use.

    Args:
        model: a model, a run folder, a saved folder, a Hub id, or a bundled model; by default faces-64.
        factors: which features, in which order; None means all of the model's.
        batch_size: images at a time.
        device: where to run ("cpu", "cuda"); None loads to the CPU and leaves a given model where it is.
    """

    def __init__(
        self, model: Any = "faces-64", factors: Sequence[str] | None = ("geometry", "albedo"),
        batch_size: int = 256, device: str | None = None,
    ):  # fmt: skip
        self.model, self.factors, self.batch_size, self.device = model, factors, batch_size, device

    def fit(self, X: Any = None, y: Any = None) -> "DisentangledFeatures":
        """Load the model and check the factors' names; images and labels are not looked at."""
        self._widths()
        return self

    def transform(self, X: Any) -> np.ndarray:
        """(N, sum of D) float32."""
        model = self._loaded()
        codes = embed_images(model, as_pixels(X, model.image_size), batch_size=self.batch_size)
        return np.concatenate([codes[name] for name in chosen(self.factors, codes)], axis=1)

    def get_feature_names_out(self, input_features: Any = None) -> np.ndarray:
        """Names such as ``geometry_0``, in the order of the columns."""
        widths = self._widths()
        return np.array([f"{name}_{i}" for name, width in widths.items() for i in range(width)], dtype=object)

    def _loaded(self) -> Any:
        if not isinstance(self.model, (str, os.PathLike)):
            return self.model if self.device is None else self.model.to(self.device)
        asked_for = (str(self.model), self.device)
        if getattr(self, "_asked_for", None) != asked_for:
            self._model = derender.load(asked_for[0], device=self.device or "cpu")
            self._asked_for = asked_for
        return self._model

    def _widths(self) -> dict[str, int]:
        model = self._loaded()
        codes = embed_images(model, np.zeros((1, 3, model.image_size, model.image_size), np.uint8))
        return {name: codes[name].shape[1] for name in chosen(self.factors, codes)}

    def __getstate__(self) -> dict[str, Any]:
        """Parameters only: a model named by its path is loaded again where the copy is used."""
        state: Any = super().__getstate__()
        return {name: value for name, value in state.items() if name not in ("_model", "_asked_for")}

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()  # pyrefly: ignore[missing-attribute]
        tags.requires_fit = False
        tags.no_validation = True
        tags.input_tags.two_d_array = False
        return tags


def as_pixels(X: Any, image_size: int) -> np.ndarray:
    """Images in any of the forms DisentangledFeatures takes, as (N, 3, S, S), uint8 or float32 in 0..1."""
    if isinstance(X, (str, os.PathLike)):
        raise ValueError(f"expected several images, got the one path {str(X)!r}: give a list of paths")
    shapes = [np.shape(item) for item in X] if isinstance(X, (list, tuple)) else []
    if odd := next((number for number, shape in enumerate(shapes) if shape != shapes[0]), 0):
        raise ValueError(f"image {odd} is {shapes[odd]}, image 0 {shapes[0]}: resize them, or give paths")
    array = X.detach().cpu().numpy() if isinstance(X, torch.Tensor) else np.asarray(X)
    if array.size and array.dtype.kind in "UO":
        if array.size != len(array):
            raise ValueError(f"expected one path for each image, got shape {array.shape}: give one column")
        paths = array.reshape(-1).tolist()
        for item in paths:
            if not isinstance(item, (str, os.PathLike)):
                raise ValueError(f"expected paths of images, got {type(item).__name__}: give paths or arrays")
        return np.stack([read_image(Path(item), image_size) for item in paths])
    if array.ndim == 4 and array.shape[1] != 3 and array.shape[3] == 3:
        array = np.moveaxis(array, 3, 1)
    if array.ndim != 4 or array.shape[1:] != (3, image_size, image_size):
        expected = f"expected images (N, 3, {image_size}, {image_size}) or (N, {image_size}, {image_size}, 3)"
        raise ValueError(f"{expected}, got shape {array.shape}: resize them, or give a list of paths")
    if array.dtype == np.uint8:
        return array
    if array.dtype.kind != "f":
        raise ValueError(f"expected images in uint8 or floats in 0..1, got {array.dtype}: convert them")
    refuse_values(array)
    return np.ascontiguousarray(array, np.float32)
