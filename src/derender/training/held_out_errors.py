"""The distance of a model's reconstructions from images it was not trained on, saved with the model.

One number per image, the mean absolute difference inside the mask; of all of them 101 quantiles, in a small
JSON file. An image with a high percentile shows another kind of object or another crop, or is broken. A low
one proves nothing: a plain surface may be easy to render whatever it shows.
"""

from collections.abc import Callable, Collection, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from derender.data import as_float
from derender.model import load
from derender.storage.atomic import write_whole
from derender.storage.bounded import read_json
from derender.storage.folder import QUANTILES, HeldOutErrors, read_config
from derender.storage.places import ERRORS_FILE, bundled_models, model_folder
from derender.training.process import evaluating

FEWEST = 20  # of fewer images nothing is saved: their largest error says little
OUTLIER_PERCENTILE = 99.0  # images above it are called out-of-distribution
EXPECTED_OUTLIERS = 0.1  # share of the images that may be; of held-out ones 0.01 are
FITTING = 90.0  # a model is recommended where images have such a percentile, or less
LEAST_EXPLAINED = 0.1  # of an image's variance, or its low error says nothing: grey noise is near to any grey

Images = UInt8[np.ndarray, "n 3 h w"] | UInt8[Tensor, "n 3 h w"]


class NotFinite(ValueError):
    """A model renders NaN or infinity."""


def reconstruction_errors(model: Any, images: Images, batch_size: int = 64) -> Float[np.ndarray, " n"]:
    """Masked L1 (0..1, best 0) of each image; infinite where nothing is rendered into it.

    A NaN among the reconstructions raises `NotFinite`.
    """
    errors = _of_reconstructions(masked_l1, model, images, batch_size)
    if broken := int(np.isnan(errors).sum()):
        which = f"the reconstructions of {broken} of {len(errors)} images"
        raise NotFinite(f"{which} are NaN: the model's training went wrong")
    return errors


def explained_variance(model: Any, images: Images, batch_size: int = 64) -> Float[np.ndarray, " n"]:
    """Share of each image's variance inside the mask that its reconstruction explains (R²): 1 at best.

    0 or less where a plain colour is as near to the image, as to noise or a plain surface.
    """
    return _of_reconstructions(_explained, model, images, batch_size)


def _explained(rendering: Any, target: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    weight, image = rendering.mask.double()[:, None], target.double()
    covered = weight.sum(dim=(2, 3), keepdim=True).clamp(min=1e-9)
    away = image - (weight * image).sum(dim=(2, 3), keepdim=True) / covered
    variance = (weight * away.square()).sum(dim=(1, 2, 3)).clamp(min=1e-9)
    return 1 - (weight * (rendering.image - image).square()).sum(dim=(1, 2, 3)) / variance


def _of_reconstructions(
    measure: Callable[[Any, Tensor], Tensor], model: Any, images: Images, batch_size: int
) -> Float[np.ndarray, " n"]:
    pixels = torch.as_tensor(np.array(images) if isinstance(images, np.ndarray) else images)
    parts = []
    with evaluating(model), torch.inference_mode():
        for batch in pixels.split(batch_size):
            target = as_float(batch.to(model.device))
            parts.append(measure(model.reconstruct(target), target).cpu())
    return torch.cat(parts).numpy()


def masked_l1(rendering: Any, target: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Mean absolute error where each rendering covers pixels, 0..1, best 0; infinite where it covers none."""
    mask = rendering.mask.double()
    off = (rendering.image.double() - target.double()).abs().mean(dim=1)
    inside = torch.where(mask > 0, mask * off, 0.0).sum(dim=(1, 2))
    covered = mask.sum(dim=(1, 2))
    return torch.where(covered > 0, inside / covered, inf)


def reconstruction_percentile(model: Any, images: Images, held_out: HeldOutErrors) -> Float[np.ndarray, " n"]:
    """Percentage (0..100) of the held-out images that the model reconstructs better than each of these.

    Images like the training data have every percentile equally often. Between stored quantiles it is
    interpolated; an image into which the model renders nothing has 100.
    """
    return percentile_of(reconstruction_errors(model, images), held_out)


def percentile_of(errors: Float[np.ndarray, " n"], held_out: HeldOutErrors) -> Float[np.ndarray, " n"]:
    """Where errors lie among the held-out ones, 0..100."""
    return np.interp(errors, held_out.quantiles, np.linspace(0, 100, len(held_out.quantiles)))


def unlike(images: Images, percentiles: Sequence[float] | np.ndarray) -> str:
    """What images that a model reconstructs badly have in common: their number, and the model that fits.

    One line of all images (N, 3, S, S), by the ``percentiles`` of their errors among the model's held-out
    ones. It is empty where no more of them are out-of-distribution than among those.
    """
    odd = np.flatnonzero(np.asarray(percentiles) > OUTLIER_PERCENTILE)
    if len(odd) <= EXPECTED_OUTLIERS * len(percentiles):
        return ""
    which = "the image is" if len(percentiles) == 1 else f"{len(odd):,} of {len(percentiles):,} images are"
    worse = f"{which} reconstructed worse than {OUTLIER_PERCENTILE:g} % of those this model was validated on"
    line = f"{worse}: another kind of object, or another crop (derender align, --frame)"
    return "; ".join(filter(None, (line, fitting_better(images[odd]))))


def fitting_better(images: Images, besides: Collection[str] = ()) -> str:
    """The bundled model, ``besides`` some, that reconstructs images best; empty where none does it well."""
    results = []
    for name in set(bundled_models()).difference(besides):
        known, config = read_errors(folder := model_folder(name)), read_config(folder)
        if known is None or config["settings"]["network"]["image_size"] != images.shape[-1]:
            continue
        if np.median(explained_variance(model := load(name), images)) >= LEAST_EXPLAINED:
            results.append((float(np.median(reconstruction_percentile(model, images, known))), name))
    worse, best = min(results, default=(100.0, ""))
    if worse >= FITTING:
        return ""
    return f"{best} fits better (worse than {worse:.0f} % of its own): try --model {best}"


def errors_of(model: Any, images: Images, batch_size: int = 64) -> HeldOutErrors:
    """The quantiles for images it was not trained on; fewer than 20 or no rendering are a ValueError."""
    if len(images) < FEWEST:
        raise ValueError(f"quantiles of errors need {FEWEST} images or more, got {len(images)}")
    errors = reconstruction_errors(model, images, batch_size)
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        raise ValueError("the model renders nothing into any of the images: see whether it was trained")
    quantiles = np.quantile(errors, np.linspace(0, 1, QUANTILES)).tolist()
    return HeldOutErrors(pictures=len(errors), quantiles=[float(f"{value:.6g}") for value in quantiles])


def store_errors(folder: Path, held_out: Images) -> None:
    """Save the errors of held-out images with the model in ``folder``, if it renders into 20 or more."""
    try:
        write_errors(folder, errors_of(load(folder), held_out))
    except NotFinite:
        raise
    except ValueError:
        return


def write_errors(folder: Path, errors: HeldOutErrors) -> Path:
    """Write the file into a saved model's folder, atomically."""
    return write_whole(folder / ERRORS_FILE, errors.model_dump_json() + "\n")


def read_errors(folder: Path) -> HeldOutErrors | None:
    """The errors saved with the model in ``folder``, None without any; a damaged file is a ValueError."""
    file = folder / ERRORS_FILE
    if not file.is_file():
        return None
    return read_json(file, HeldOutErrors, "make it again with derender evaluate reconstruction --store")
