"""Does a probe's answer hold under other light and from other sides? Curves over angles, and their area.

trial     axes of light and camera; training images, and test images at each angle, and where they come from
compare   probes, curves, intervals, controls: ``robustness``
"""

from derender.evaluation.robust.compare import (
    CurveResult,
    RobustnessComparison,
    area_under,
    compare_robustness,
    robustness,
)

__all__ = ["CurveResult", "RobustnessComparison", "area_under", "compare_robustness", "robustness"]
