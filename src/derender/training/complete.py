"""What a saved model is given once its run has ended: whitening, fitting, and which errors are usual."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from derender.model import load
from derender.training.config import TrainConfig
from derender.training.features import make_features
from derender.training.held_out_errors import store_errors


def complete_model(
    folder: Path,
    config: TrainConfig,
    training: UInt8[np.ndarray, "n 3 h w"],
    held_out: UInt8[np.ndarray, "m 3 h w"],
    *,
    device: str | torch.device = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Add whitening and fitting, made of training pictures, and errors of held-out ones to a model.

    Args:
        folder: of the saved model.
        config: of its run.
        training, held_out: pictures at the model's size.
        device: where to compute.
        progress: called with (pictures done, pictures in all).
    """
    model = load(folder, device=device)
    model = make_features(
        model, torch.from_numpy(training), config.features, seed=config.seed, progress=progress
    )
    model.features.save(folder)
    store_errors(folder, torch.from_numpy(held_out))
