"""Does a probe's answer hold under other light and from other sides? Curves over angles, and their area.

trial     axes of light and camera; training images, and test images at each angle
sources   trials of generated images, of images re-rendered by a model, and of images with known angles
compare   probes, curves, intervals, controls
"""

from derender.evaluation.robust.compare import (
    CurveResult,
    RobustnessComparison,
    area_under,
    compare_robustness,
)
from derender.evaluation.robust.sources import (
    KINDS,
    Recipe,
    generated_trial,
    rendered_trial,
    true_angle_trial,
)
from derender.evaluation.robust.trial import AXES, Curve, Trial, checked_levels, chosen_axes

__all__ = [
    "AXES",
    "KINDS",
    "Curve",
    "CurveResult",
    "Recipe",
    "RobustnessComparison",
    "Trial",
    "area_under",
    "checked_levels",
    "chosen_axes",
    "compare_robustness",
    "generated_trial",
    "rendered_trial",
    "true_angle_trial",
]
