"""Does what a probe learned hold under other light and from other sides? Curves over angles, and their area.

axes: which way light or camera turn; trial: pictures, who learns, who is tested at which angle. A trial comes
from generated pictures (generated), from pictures rendered again by a model (rendered), or from pictures
whose true angles are known (turned). compare: probes, curves, intervals, controls.
"""

from derender.evaluation.robustness.axes import AXES, Axis, checked_levels, chosen_axes
from derender.evaluation.robustness.compare import (
    CurveResult,
    RobustnessComparison,
    area_under,
    compare_robustness,
)
from derender.evaluation.robustness.generated import KINDS, Recipe, generated_trial
from derender.evaluation.robustness.rendered import rendered_trial
from derender.evaluation.robustness.trial import Curve, Trial
from derender.evaluation.robustness.turned import turned_trial

__all__ = [
    "AXES",
    "KINDS",
    "Axis",
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
    "turned_trial",
]
