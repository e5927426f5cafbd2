"""A trial as a value: images, their task, training rows, and test rows at growing angles of light or camera.

Every curve names rows of one stack of images, so that features are computed once for all of it. Turning the
camera leaves the light where it is, turning the light leaves ambient and diffuse. Angles are degrees because
axes of charts show them; 0 is the front. Leaves out where images come from (sources.py) and every score.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int64, UInt8

from derender.data import ImageSet, suggestion
from derender.evaluation.linear_task import Task
from derender.scene import Scene

LEVELS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
MOST_DEG = 85.0
Fixed = Mapping[str, tuple[float, float]]
"""Ranges of a generator's settings that hold an angle fixed, by name."""


@dataclass(frozen=True)
class Axis:
    """One way to turn light or camera.

    Attributes:
        name: of the option.
        title: in tables and charts.
        part: of a generator's settings, "view" or "light".
        fixed: by kind of generated image, the settings of that part for an angle in degrees.
        column: of a scene's camera or light.
        cleared: columns that are set to 0, so that the angle is the whole angle.
        truth: labels (radians) of the angle; with two, the angle of a light's direction off the front.
        most_deg: the largest angle.
    """

    name: str
    title: str
    part: str
    fixed: Mapping[str, Callable[[float], Fixed]]
    column: int
    cleared: tuple[int, ...]
    truth: tuple[str, ...]
    most_deg: float = MOST_DEG

    def rotated(self, scene: Scene, angle_deg: float) -> Scene:
        """The scenes at this angle instead of their own; sign as in docs/conventions.md."""
        name = "camera" if self.part == "view" else "light"
        values = scene.parameters[name].clone()
        values[:, list(self.cleared)] = 0
        values[:, self.column] = math.radians(angle_deg)
        return scene.with_parameters(**{name: values})

    def true_deg(self, labels: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) angles off the front by the labels, in degrees, 0 or more.

        Raises:
            ValueError: there is no label of the angle.
        """
        absent = [name for name in self.truth if name not in labels]
        if absent:
            raise ValueError(
                f"the true {self.title} is not among the labels (there is no {absent[0]!r}): give rendered "
                "images with a params.csv, as derender synth writes them"
            )
        angles = [np.asarray(labels[name], np.float64) for name in self.truth]
        if len(angles) == 1:
            return np.degrees(np.abs(angles[0]))
        return np.degrees(np.arctan(np.hypot(*(np.tan(angle) for angle in angles))))


def _both(angle: float) -> tuple[float, float]:
    return (angle, angle)


AXES: Mapping[str, Axis] = {
    axis.name: axis
    for axis in (
        Axis(
            "yaw", "camera yaw", "view",
            {"faces": lambda a: {"yaw_deg": _both(a)}, "cars": lambda a: {"azimuth_deg": _both(a)}},
            1, (), ("camera_y_rad",),
        ),
        Axis(
            "pitch", "camera pitch", "view",
            {"faces": lambda a: {"pitch_deg": _both(a)}},
            0, (), ("camera_x_rad",), most_deg=60.0,
        ),
        Axis(
            "light", "light from the side", "light",
            dict.fromkeys(("faces", "cars"), lambda a: {"yaw_deg": _both(a), "pitch_deg": (0.0, 0.0)}),
            3, (2,), ("light_yaw_rad", "light_pitch_rad"),
        ),
        Axis(
            "light-pitch", "light from above and below", "light",
            dict.fromkeys(("faces", "cars"), lambda a: {"pitch_deg": _both(a), "yaw_deg": (0.0, 0.0)}),
            2, (3,), ("light_pitch_rad",),
        ),
    )
}  # fmt: skip
"""By name of the option."""


def chosen_axes(names: Sequence[str], kind: str | None = None) -> tuple[Axis, ...]:
    """Axes by name; an unknown one, or one about which generated images cannot be rotated, is an error."""
    for name in names:
        if name not in AXES:
            raise ValueError(f"no axis {name!r}{suggestion(name, AXES)}: there is {', '.join(AXES)}")
        if kind is not None and kind not in AXES[name].fixed:
            raise ValueError(f"generated {kind} cannot be rotated about the axis {name!r}: leave it out")
    if not names:
        raise ValueError(f"name an axis: there is {', '.join(AXES)}")
    return tuple(AXES[name] for name in dict.fromkeys(names))


def checked_levels(levels: Sequence[float], axes: Sequence[Axis]) -> tuple[float, ...]:
    """Angles in degrees, checked against the largest of every axis."""
    most = min(axis.most_deg for axis in axes)
    found = tuple(float(level) for level in levels)
    if len(found) < 2 or any(b <= a for a, b in pairwise(found)):
        raise ValueError(f"angles must be two or more that grow, such as 0,30,60; got {_words(found)}")
    if found[0] < 0 or found[-1] > most:
        raise ValueError(
            f"angles must lie within 0..{most:g} degrees for {', '.join(axis.name for axis in axes)}, "
            f"got {_words(found)}"
        )
    return found


def either_side(level: float) -> tuple[float, ...]:
    """The angle to the one side and to the other; 0 once."""
    return (0.0,) if level == 0 else (-level, level)


def all_angles(axes: Sequence[Axis], levels: Sequence[float]) -> list[tuple[Axis, float]]:
    """Every axis at every level to either side, in the order of a trial's images."""
    return [(axis, angle) for axis in axes for level in levels for angle in either_side(level)]


def _words(levels: Sequence[float]) -> str:
    return ", ".join(f"{level:g}" for level in levels) or "none"


@dataclass(frozen=True)
class Curve:
    """Tests at growing angles, after learning from the same rows.

    Attributes:
        name, title: of the axis.
        learn: (n,) training rows: ordinary light and view.
        ordinary: (t,) rows tested in ordinary light and view.
        levels: (L,) angles in degrees, growing.
        tested: for every level, its rows; none of the training units is among them.
    """

    name: str
    title: str
    learn: Int64[np.ndarray, " n"]
    ordinary: Int64[np.ndarray, " t"]
    levels: tuple[float, ...]
    tested: tuple[Int64[np.ndarray, " _"], ...]

    @property
    def points(self) -> tuple[np.ndarray, ...]:
        """Rows tested, ordinary ones first."""
        return (self.ordinary, *self.tested)


@dataclass(frozen=True)
class Trial:
    """Everything a probe needs.

    Attributes:
        images: (M, 3, S, S) all images, for training and tests.
        task: targets of the M rows.
        unit: (M,) the unit of resampling: rows of one unit (the same face at several angles, the images of
            one person, a track) are drawn together.
        curves: one for each axis.
        how: the source of other lights and views, in words.
        n_dropped: rows left out because they carry no label.
    """

    images: UInt8[np.ndarray, "m 3 s s"]
    task: Task
    unit: Int64[np.ndarray, " m"]
    curves: tuple[Curve, ...]
    how: str
    n_dropped: int = 0

    def __post_init__(self) -> None:
        if not len(self.images) == len(self.task) == len(self.unit):
            raise ValueError(
                f"a trial needs a target and a unit for every image, got {len(self.images)} images, "
                f"{len(self.task)} targets and {len(self.unit)} units"
            )
        for curve in self.curves:
            if len(curve.levels) != len(curve.tested) or any(b <= a for a, b in pairwise(curve.levels)):
                raise ValueError(f"curve {curve.name!r} needs growing angles with rows for each")
            if len(curve.learn) < 5 or not all(len(rows) for rows in curve.points):
                raise ValueError(
                    f"{curve.title}: {len(curve.learn)} rows to learn from and "
                    f"{', '.join(str(len(rows)) for rows in curve.points)} to be tested on: five and one "
                    "are the least; give more images"
                )
            both = np.intersect1d(self.unit[curve.learn], self.unit[np.concatenate(curve.points)])
            if len(both):
                raise ValueError(f"{curve.title}: {len(both)} units would be both learned from and tested")

    @property
    def pictures(self) -> ImageSet:
        """All images, to compute features of."""
        return ImageSet(self.images, tuple(f"{row:06d}" for row in range(len(self.images))), source=self.how)

    @property
    def learned(self) -> np.ndarray:
        """Training rows of any curve."""
        return np.unique(np.concatenate([curve.learn for curve in self.curves]))


def stacked_trial(
    images: np.ndarray,
    task: Task,
    unit: np.ndarray,
    n_learn: int,
    axes: Sequence[Axis],
    levels: tuple[float, ...],
    how: str,
    n_dropped: int,
) -> Trial:
    """A trial of ``n_learn`` training images, T test images, and these at ``all_angles``, in this order.

    Args:
        images: (M, 3, S, S) the whole stack.
        task, unit: of the training and test images; rows without a label are left out.
        n_learn: number of training images.
        axes, levels: of the curves.
        how, n_dropped: as in ``Trial``.
    """
    test = np.arange(n_learn, len(task))
    shown = np.concatenate((np.arange(len(task)), np.tile(test, len(all_angles(axes, levels)))))
    task = Task(task.kind, task.names, task.targets[shown])
    known, start = task.known, n_learn

    def next_rows(count: int) -> np.ndarray:
        nonlocal start
        start += count
        return start - count + np.flatnonzero(known[start - count : start])

    learn, ordinary = np.flatnonzero(known[:n_learn]), next_rows(len(test))
    curves = []
    for axis in axes:
        tested = tuple(next_rows(len(test) * len(either_side(level))) for level in levels)
        curves.append(Curve(axis.name, axis.title, learn, ordinary, levels, tested))
    return Trial(images, task, unit[shown].astype(np.int64), tuple(curves), how, n_dropped)
