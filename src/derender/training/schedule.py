"""What follows from the number of pictures seen: the learning rate, and when a state is kept."""

import math

from derender.training.config import OptimiserSettings

FIRST_KEPT_IMAGES = 300
"""About when the first state of a run with long intervals is kept."""


def learning_rate(settings: OptimiserSettings, images: int, total_images: int) -> float:
    """Linear warm-up from zero, then constant, or along a cosine to ``final_rate`` of the rate."""
    if images < settings.warmup_images:
        return settings.learning_rate * (images + 1) / settings.warmup_images
    span = max(total_images - settings.warmup_images, 1)
    done = min((images - settings.warmup_images) / span, 1.0)
    share = settings.final_rate + (1 - settings.final_rate) * (1 + math.cos(math.pi * done)) / 2
    return settings.learning_rate * share


def passed(before: int, now: int, interval: int, *, ended: bool) -> bool:
    """Whether a multiple of ``interval`` lies in (before, now], or the run has ended."""
    return ended or now // interval > before // interval


def kept(before: int, now: int, interval: int, *, ended: bool) -> bool:
    """Whether a state in (before, now] is to be kept: as ``passed``, and at halves of the first interval.

    Those (half, a quarter, ... down to ``FIRST_KEPT_IMAGES``) see to it that a collapse, which happens early
    if at all, leaves a good state behind whatever the interval.
    """
    early = interval // 2
    while early >= FIRST_KEPT_IMAGES:
        if before < early <= now:
            return True
        early //= 2
    return passed(before, now, interval, ended=ended)
