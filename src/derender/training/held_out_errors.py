"""How far a model's reconstructions lie from pictures it was not trained on, kept with the model.

One number per picture, the mean absolute difference inside the mask; of all of them 101 quantiles, in a small
JSON file of the saved model's folder. Leaves out judging an image by them
(``evaluation/out_of_distribution.py``).
"""

import json
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from derender.data import as_float
from derender.model import load
from derender.storage.atomic import atomic_file
from derender.storage.folder import ERRORS_FILE

FORMAT = 1
QUANTILES = 101
FEWEST = 20
"""Of fewer pictures nothing is kept: their largest error says little."""


class NotFinite(ValueError):
    """A model renders what is no number."""


@dataclass(frozen=True)
class HeldOutErrors:
    """The reconstruction errors of pictures a model was validated on.

    Attributes:
        quantiles: (101,) the masked L1 (0..1) that 0, 1, ... 100 % of the pictures do not exceed.
        pictures: how many there were.
    """

    quantiles: Float[np.ndarray, " 101"]
    pictures: int


def reconstruction_errors(
    model: Any, images: UInt8[np.ndarray, "n 3 h w"] | UInt8[Tensor, "n 3 h w"], batch_size: int = 64
) -> Float[np.ndarray, " n"]:
    """Masked L1 (0..1, best 0) of each picture; infinite where the model renders nothing into the picture.

    Raises:
        NotFinite: a reconstruction is no number.
    """
    pictures = torch.as_tensor(np.array(images) if isinstance(images, np.ndarray) else images)
    was_training = model.training
    model.eval()
    errors = []
    try:
        with torch.inference_mode():
            for batch in pictures.split(batch_size):
                target = as_float(batch.to(model.device))
                errors.append(masked_l1(model.reconstruct(target), target).cpu())
    finally:
        model.train(was_training)
    found = torch.cat(errors).numpy()
    if np.isnan(found).any():
        raise NotFinite(
            f"the reconstructions of {int(np.isnan(found).sum())} of {len(found)} pictures are no numbers: "
            "the model's training went wrong"
        )
    return found


def masked_l1(rendering: Any, target: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Mean absolute error where each rendering shows something, 0..1, best 0; infinite where nothing."""
    mask = rendering.mask.double()
    off = (rendering.image.double() - target.double()).abs().mean(dim=1)
    inside = torch.where(mask > 0, mask * off, 0.0).sum(dim=(1, 2))
    covered = mask.sum(dim=(1, 2))
    return torch.where(covered > 0, inside / covered, inf)


def errors_of(
    model: Any, images: UInt8[np.ndarray, "n 3 h w"] | UInt8[Tensor, "n 3 h w"], batch_size: int = 64
) -> HeldOutErrors:
    """The quantiles for pictures the model was not trained on."""
    if len(images) < FEWEST:
        raise ValueError(f"the errors of {FEWEST} pictures or more say something; got {len(images)}")
    errors = reconstruction_errors(model, images, batch_size)
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        raise ValueError("the model renders nothing into any of the pictures: see whether it was trained")
    return HeldOutErrors(np.quantile(errors, np.linspace(0, 1, QUANTILES)), len(errors))


def store_errors(folder: Path, held_out: UInt8[Tensor, "n 3 h w"]) -> HeldOutErrors | None:
    """Measure the model saved in ``folder`` on held-out pictures and keep what was found with it.

    Nothing is kept, and None given, for fewer than 20 pictures and for a model that renders nothing.
    """
    try:
        errors = errors_of(load(folder, device=held_out.device), held_out)
    except NotFinite:
        raise
    except ValueError:
        return None
    write_errors(folder, errors)
    return errors


def write_errors(folder: Path, errors: HeldOutErrors) -> Path:
    """Write the file into a saved model's folder; whole or not at all."""
    values = {
        "format": FORMAT,
        "measure": "mean absolute difference inside the mask, 0..1",
        "pictures": errors.pictures,
        "quantiles": [float(f"{value:.6g}") for value in errors.quantiles.tolist()],
    }
    with atomic_file(folder / ERRORS_FILE) as temporary:
        temporary.write_text(json.dumps(values) + "\n")
    return folder / ERRORS_FILE


def read_errors(folder: Path) -> HeldOutErrors | None:
    """What was kept with the model in ``folder``; None where nothing was.

    Raises:
        ValueError: the file is damaged or of a newer version.
    """
    file = folder / ERRORS_FILE
    if not file.is_file():
        return None
    try:
        values = json.loads(file.read_text())
        quantiles, pictures, version = values["quantiles"], values["pictures"], values["format"]
        sound = (
            version == FORMAT
            and len(quantiles) == QUANTILES
            and all(isfinite(value) and value >= 0 for value in quantiles)
            and sorted(quantiles) == quantiles
        )
        found = HeldOutErrors(np.array(quantiles, np.float64), int(pictures)) if sound else None
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError):
        found = None
    if found is None:
        raise ValueError(
            f"{file} is damaged or of a newer version: make it again with "
            "derender evaluate reconstruction --store"
        )
    return found
