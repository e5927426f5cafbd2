"""The learning rate as a function of pictures seen."""

import math

from derender.training.config import OptimiserSettings


def learning_rate(settings: OptimiserSettings, images: int, total_images: int) -> float:
    """Linear warm-up from zero, then constant, or along a cosine to ``final_rate`` of the rate."""
    if images < settings.warmup_images:
        return settings.learning_rate * (images + 1) / settings.warmup_images
    span = max(total_images - settings.warmup_images, 1)
    done = min((images - settings.warmup_images) / span, 1.0)
    share = settings.final_rate + (1 - settings.final_rate) * (1 + math.cos(math.pi * done)) / 2
    return settings.learning_rate * share
