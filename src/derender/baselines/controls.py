"""Controls without training: pixels, PCA, Gradientfaces, HOG, LBP, noise, and an untrained encoder.

Histograms of oriented gradients: Dalal and Triggs (CVPR 2005), as scikit-image (BSD) computes them: nine
orientations, cells of 8x8 pixels, blocks of 2x2 cells, L2-Hys; 1,764 numbers at 64x64 pixels. Local binary
patterns: Ahonen et al. (ECCV 2004), eight neighbours at two pixels, 59 uniform patterns, square roots of
their shares in cells of 8x8 pixels. Gradientfaces: Zhang et al. (TIP 2009), the direction of the gradient,
which keeps faces apart in any light.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from skimage import feature

from derender.data import ImageSet
from derender.features import FeatureTable, Progress, table_labels
from derender.inputs import part_of
from derender.model import load

ORIENTATIONS, BLOCK_CELLS, CELL_PX = 9, 2, 8
BLUR_PX = 0.75
LUMINANCE = (0.299, 0.587, 0.114)  # weights of red, green and blue in brightness (ITU-R BT.601)
UNIFORM_PATTERNS = 59


def control_features(
    name: str, images: ImageSet, part: str = "all", model: str | Path | None = None, *, components: int = 64,
    seed: int = 0, progress: Progress | None = None,
) -> FeatureTable:  # fmt: skip
    """The table of a control by its name, one of ``CONTROLS``, which is also that of its only factor.

    ``part`` is one of the split of ``model``; its principal components are those of the training part.
    ``components`` is the number of dimensions of pca and noise, ``seed`` that of pca's solver and of noise.
    ``progress`` is called with (images done, all).
    """
    chosen = part_of(images, part, model)
    if name == "pixels":
        return pixel_features(chosen)
    if name in DESCRIPTORS:
        return descriptor_features(name, chosen, progress=progress)
    if name == "noise":
        noise = np.random.default_rng(seed).standard_normal((len(chosen), components))
        return control_table(chosen, name, noise, {"seed": seed})  # the chance level of any protocol
    fit_on = chosen if part == "all" else part_of(images, "train", model)
    return pca_features(chosen, components=components, fit_on=fit_on, seed=seed)


def control_table(images: ImageSet, name: str, values: np.ndarray, facts: Mapping[str, Any]) -> FeatureTable:
    """One factor (N, D) as a table, with the images' names and labels; ``facts`` go into its origin."""
    origin = {"data": images.source, "layout": images.layout, "control": name, **facts}
    return FeatureTable(images.files, {name: values.astype(np.float32)}, table_labels(images), origin)


def flat_pixels(images: np.ndarray) -> np.ndarray:
    """(N, H * W * 3) in 0..1."""
    return np.asarray(images, np.float32).reshape(len(images), -1) / 255


def pixel_features(images: ImageSet) -> FeatureTable:
    """Pixels themselves, in 0..1, flattened: factor ``pixels``."""
    return control_table(images, "pixels", flat_pixels(images.images), {})


def pca_features(
    images: ImageSet, *, components: int = 64, fit_on: ImageSet | None = None, seed: int = 0
) -> FeatureTable:
    """Principal components of the pixels, each of variance 1: factor ``pca``.

    ``fit_on`` gives the components; by default ``images`` themselves. ``seed`` is of the randomised solver.
    """
    from sklearn.decomposition import PCA

    source = (images if fit_on is None else fit_on).require(2, "PCA")
    limit = min(len(source), source.images[0].size)
    if not 1 <= components <= limit:
        given = f"{len(source)} images: ask for 1 to {limit}"
        raise ValueError(f"{components} components cannot be had from {given}")
    pca = PCA(components, whiten=True, random_state=seed).fit(flat_pixels(source.images))
    facts = {"components": components, "whiten": True, "fitted_on": len(source), "seed": seed}
    return control_table(images, "pca", pca.transform(flat_pixels(images.images)), facts)


def hog(image: np.ndarray) -> np.ndarray:
    """Histograms of oriented gradients of (3, H, W) bytes; each block of 36 numbers has length 1 at most."""
    height, width = image.shape[1:]
    if min(height, width) < BLOCK_CELLS * CELL_PX:
        raise ValueError(f"{height}x{width} pixels are too few: HOG needs {BLOCK_CELLS * CELL_PX} a side")
    return feature.hog(
        np.moveaxis(image, 0, -1), orientations=ORIENTATIONS, block_norm="L2-Hys",
        pixels_per_cell=(CELL_PX, CELL_PX), cells_per_block=(BLOCK_CELLS, BLOCK_CELLS), channel_axis=-1,
    )  # fmt: skip


def lbp(image: np.ndarray) -> np.ndarray:
    """Square roots of shares of local binary patterns in cells of (3, H, W) bytes; each cell has length 1.

    Pixels beyond the last whole cell at the right and below are not described.
    """
    grey = _luma(image).round().astype(np.uint8)
    codes = feature.local_binary_pattern(grey, 8, 2, "nri_uniform").astype(np.int64)
    rows, columns = (side // CELL_PX for side in codes.shape)
    cell = np.arange(rows * columns).reshape(rows, columns).repeat(CELL_PX, 0).repeat(CELL_PX, 1)
    numbers = cell * UNIFORM_PATTERNS + codes[: rows * CELL_PX, : columns * CELL_PX]
    counts = np.bincount(numbers.ravel(), minlength=rows * columns * UNIFORM_PATTERNS)
    return np.sqrt(counts) / CELL_PX


def gradientfaces(image: np.ndarray) -> np.ndarray:
    """Cosine and sine of the direction of each pixel's gradient after a Gaussian blur of 0.75 pixels.

    Two numbers a pixel of (3, H, W) bytes; a pixel without a gradient has direction 0.
    """
    down, right = np.gradient(gaussian_filter(_luma(image), BLUR_PX))
    angle = np.arctan2(down, right)
    return np.concatenate([np.cos(angle).ravel(), np.sin(angle).ravel()])


DESCRIPTORS: Mapping[str, tuple[Callable[[np.ndarray], np.ndarray], Mapping[str, Any]]] = {
    "gradientfaces": (gradientfaces, {"blur_px": BLUR_PX}),
    "hog": (hog, {"orientations": ORIENTATIONS, "cell_px": CELL_PX, "block": BLOCK_CELLS}),
    "lbp": (lbp, {"cell_px": CELL_PX}),
}  # controls that describe each image by itself, and know nothing of others; and the facts of their tables


def descriptor_features(name: str, images: ImageSet, *, progress: Progress | None = None) -> FeatureTable:
    """The table of one of ``DESCRIPTORS``, which is also its factor."""
    (describe, facts), rows = DESCRIPTORS[name], []
    for image in images.images:
        rows.append(describe(np.asarray(image)).astype(np.float32))
        if progress is not None and (len(rows) % 64 == 0 or len(rows) == len(images)):
            progress(len(rows), len(images))
    return control_table(images, name, np.stack(rows), facts)


def _luma(image: np.ndarray) -> np.ndarray:
    """Brightness 0..255 of (3, H, W)."""
    return np.tensordot(LUMINANCE, image.astype(np.float64), 1)


def untrained_twin(model: Any, seed: int) -> Any:
    """The same settings, factors and renderer with fresh weights; torch's global generator is left alone."""
    twin = type(model).seeded(model.settings, seed, factors=model.factors, renderer=model.renderer)
    return twin.to(model.device, memory_format=torch.channels_last).eval()


class Untrained:
    """The untrained twin of a derender model, among the baselines with a network."""

    @staticmethod
    def open(source: str | Path | None, *, image_size: int | None = None, seed: int = 0) -> Any:
        """See `open_baseline`."""
        if source is None:
            raise ValueError("the baseline untrained needs a model: the derender model to copy")
        return untrained_twin(load(source), seed)
