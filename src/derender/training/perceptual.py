"""The perceptual features of a run: learnt or loaded once, kept in its folder, the same after a resume."""

import warnings
from collections.abc import Callable
from pathlib import Path

from jaxtyping import UInt8
from torch import Tensor

from derender.objectives.perceptual import PerceptualFeatures, build_perceptual
from derender.objectives.self_features import SelfFeatures, load_self_features
from derender.storage.atomic import DamageNoticed, atomic_file
from derender.training.config import TrainConfig


def prepare_perceptual(
    config: TrainConfig,
    file: Path,
    images: UInt8[Tensor, "n 3 h w"],
    progress: Callable[[int, int, float], None] | None = None,
) -> PerceptualFeatures | None:
    """Features of the kind that the configuration names, or None where it names none or gives them no weight.

    Self-trained features are read from ``file`` where it exists, else learnt and written there.
    """
    objective = config.objective
    if objective.perceptual == "none" or objective.perceptual_weight == 0:
        return None
    if objective.perceptual == "self" and file.exists():
        try:
            return load_self_features(file).to(images.device)
        except ValueError as problem:
            warnings.warn(
                f"{problem}: they are learnt again, from the same seed", DamageNoticed, stacklevel=2
            )
    features = build_perceptual(
        objective.perceptual,
        images,
        weights=objective.vgg16_path,
        seed=config.seed,
        steps=objective.self_features_steps,
        progress=progress,
        device=images.device,
    )
    if isinstance(features, SelfFeatures):
        with atomic_file(file) as temporary:
            features.save(temporary)
    return features
