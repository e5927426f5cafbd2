"""Histograms of oriented gradients: what edges alone say, without any learning.

Source: Dalal and Triggs, *Histograms of Oriented Gradients for Human Detection* (CVPR 2005), as scikit-image
(BSD) computes it: nine orientations, cells of 8x8 pixels, blocks of 2x2 cells, L2-Hys; 1,764 numbers at
64x64.
"""

import numpy as np

from derender.baselines.controls import control_table
from derender.baselines.extras import optional
from derender.data import PictureSet
from derender.features import FeatureTable, Progress

ORIENTATIONS, BLOCK_CELLS = 9, 2


def hog_features(pictures: PictureSet, *, cell_px: int = 8, progress: Progress | None = None) -> FeatureTable:
    """Histograms of every picture, factor ``hog``; each block of 36 has length 1 at most.

    Args:
        pictures: what to describe.
        cell_px: side of a cell in pixels; a picture has at least two cells a side.
        progress: called with (pictures done, pictures in all).
    """
    height, width = pictures.images.shape[-2:]
    if not 1 <= cell_px <= min(height, width) // BLOCK_CELLS:
        raise ValueError(
            f"cells of {cell_px} pixels do not fit {BLOCK_CELLS} a side into {height}x{width}: "
            f"ask for 1 to {min(height, width) // BLOCK_CELLS}"
        )
    feature = optional("skimage.feature", "the baseline hog")
    rows = []
    for row, image in enumerate(pictures.images):
        values = feature.hog(
            np.moveaxis(np.asarray(image), 0, -1),
            orientations=ORIENTATIONS,
            pixels_per_cell=(cell_px, cell_px),
            cells_per_block=(BLOCK_CELLS, BLOCK_CELLS),
            block_norm="L2-Hys",
            channel_axis=-1,
        )
        rows.append(values.astype(np.float32))
        if progress is not None and (row % 64 == 63 or row == len(pictures) - 1):
            progress(row + 1, len(pictures))
    origin = {"control": "hog", "orientations": ORIENTATIONS, "cell_px": cell_px, "block": BLOCK_CELLS}
    return control_table(pictures, "hog", np.stack(rows), origin)
