"""A trial of pictures whose true angles are known: learned from the least turned, tested on the most turned.

For tracks of rendered people in light and views that nobody trained on, and for any rendered set. The unit is
the track where there are tracks, else the picture. Of every class, the less turned half of its units is
ordinary: three of four are learned from, the fourth is tested as the curve's first point. The other half is
tested, in as many portions as asked for, by growing angle. Unlike the other trials, each angle shows other
pictures, and turned ones may be hard for other reasons.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from derender.data import PictureSet
from derender.evaluation.linear_task import Task
from derender.evaluation.robustness.axes import Axis
from derender.evaluation.robustness.trial import Curve, Trial

PORTIONS = 3


def turned_trial(
    pictures: PictureSet, task: Task, axes: Sequence[Axis], *, portions: int = PORTIONS
) -> Trial:
    """Divide the pictures along every axis by their true angles.

    Args:
        pictures: with labels that tell light or view.
        task: what is asked of each picture.
        axes: by which angles.
        portions: of the more turned half.

    Raises:
        ValueError: the labels do not tell an angle, or there are too few pictures.
    """
    named = pictures.labels.get("track", np.arange(len(pictures)))
    unit = np.unique(named, return_inverse=True)[1].astype(np.int64)
    curves = []
    for axis in axes:
        angle = axis.true_deg(pictures.labels)
        curves.append(_curve(axis, angle, unit, task, portions))
    how = f"the less and the more turned half of {pictures.layout}"
    return Trial(pictures.images, task, unit, tuple(curves), how, int((~task.known).sum()))


def _curve(axis: Axis, angle: np.ndarray, unit: np.ndarray, task: Task, portions: int) -> Curve:
    usable = task.known & np.isfinite(angle)
    units = np.unique(unit[usable])
    rows_of = {one: np.flatnonzero(usable & (unit == one)) for one in units.tolist()}
    turn = {one: float(angle[rows].mean()) for one, rows in rows_of.items()}
    learn, ordinary, far = [], [], []
    for members in _by_class(rows_of, task):
        order = sorted(members, key=lambda one: (turn[one], one))
        near = order[: len(order) // 2]
        far += order[len(order) // 2 :]
        ordinary += near[2::4]
        learn += [one for place, one in enumerate(near) if place % 4 != 2]
    far.sort(key=lambda one: (turn[one], one))
    parts = [part for part in np.array_split(np.array(far, np.int64), portions) if len(part)]

    def rows(members: Sequence[int] | np.ndarray) -> np.ndarray:
        return np.sort(np.concatenate([rows_of[int(one)] for one in members] or [np.zeros(0, np.int64)]))

    tested = [rows(part) for part in (ordinary, *parts)]
    levels = tuple(float(angle[part].mean()) if len(part) else float("nan") for part in tested)
    if len(levels) < 2 or not all(b - a > 1e-6 for a, b in pairwise(levels)):
        raise ValueError(
            f"the true {axis.title} cannot be cut into {portions} portions of growing angle: the pictures "
            "are too few, or turned alike"
        )
    return Curve(axis.name, f"true {axis.title}", rows(learn), tested[0], levels, tuple(tested))


def _by_class(rows_of: dict[int, np.ndarray], task: Task) -> list[list[int]]:
    """Units by the class of their first row; all together where labels are several."""
    if task.kind != "classes" and task.targets.shape[1] > 1:
        return [list(rows_of)]
    found: dict[bytes, list[int]] = {}
    for one, rows in rows_of.items():
        found.setdefault(task.targets[rows[0]].tobytes(), []).append(one)
    return list(found.values())
