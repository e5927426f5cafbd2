"""A trial as a value: images, their task, training rows, and test rows at growing angles of light or camera.

Every curve names rows of one stack of images, so that features are computed once for all of it. Turning the
camera leaves the light where it is, turning the light leaves ambient and diffuse. Angles are degrees because
axes of charts show them; 0 is the front. Leaves out where images come from (sources.py) and every score.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int64, UInt8

from derender.data import ImageSet
from derender.evaluation.linear_task import Task
from derender.features import named
from derender.scene import Scene

LEVELS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)


@dataclass(frozen=True)
class Axis:
    """One way to turn light or camera.

    ``part`` is that of a generator's settings, "view" or "light"; ``settings`` has, by kind of generated
    image, the name of the angle's range there. ``column`` is that of a scene's camera or light. ``truth`` are
    the labels (radians) of the angle; two mean a light's direction. The column ``cleared`` of a scene and the
    setting ``held`` of generated images are set to 0.
    """

    name: str
    title: str
    part: str
    settings: Mapping[str, str]
    column: int
    truth: tuple[str, ...]
    cleared: int | None = None
    held: str | None = None
    most_deg: float = 85.0

    def fixed(self, kind: str, angle_deg: float) -> dict[str, tuple[float, float]]:
        """Ranges of a generator's settings that hold the angle fixed."""
        result = {self.settings[kind]: (angle_deg, angle_deg)}
        return result if self.held is None else {**result, self.held: (0.0, 0.0)}

    def rotated(self, scene: Scene, angle_deg: float) -> Scene:
        """The scenes at this angle instead of their own; sign as in docs/reference/conventions.md."""
        name = "camera" if self.part == "view" else "light"
        values = scene.parameters[name].clone()
        if self.cleared is not None:
            values[:, self.cleared] = 0
        values[:, self.column] = math.radians(angle_deg)
        return scene.with_parameters(**{name: values})

    def true_deg(self, labels: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) angles off the front by the labels, in degrees, 0 or more; without these labels an error."""
        if absent := [name for name in self.truth if name not in labels]:
            raise ValueError(
                f"the true {self.title} is not among the labels (there is no {absent[0]!r}): give rendered "
                "images with a params.csv, as derender synth writes them"
            )
        angles = [np.asarray(labels[name], np.float64) for name in self.truth]
        if len(angles) == 1:
            return np.degrees(np.abs(angles[0]))
        return np.degrees(np.arctan(np.hypot(*(np.tan(angle) for angle in angles))))


_PITCH, _YAW = {"faces": "pitch_deg", "cars": "pitch_deg"}, {"faces": "yaw_deg", "cars": "yaw_deg"}
AXES: Mapping[str, Axis] = {
    axis.name: axis
    for axis in (
        Axis("yaw", "camera yaw", "view", {**_YAW, "cars": "azimuth_deg"}, 1, ("camera_y_rad",)),
        Axis("pitch", "camera pitch", "view", {"faces": "pitch_deg"}, 0, ("camera_x_rad",), most_deg=60.0),
        Axis(
            "light", "light from the side", "light", _YAW, 3, ("light_yaw_rad", "light_pitch_rad"),
            cleared=2, held="pitch_deg",
        ),
        Axis(
            "light-pitch", "light from above and below", "light", _PITCH, 2, ("light_pitch_rad",),
            cleared=3, held="yaw_deg",
        ),
    )
}  # fmt: skip
"""By name of the option."""


def chosen_axes(names: Sequence[str], kind: str | None = None) -> tuple[Axis, ...]:
    """Axes by name; an unknown one, or one about which generated images cannot be rotated, is an error."""
    if not names:
        raise ValueError(f"name an axis: there is {', '.join(AXES)}")
    axes = tuple(named(AXES, name, "axis") for name in dict.fromkeys(names))
    for axis in axes:
        if kind is not None and kind not in axis.settings:
            raise ValueError(f"generated {kind} cannot be rotated about the axis {axis.name!r}: leave it out")
    return axes


def checked_levels(levels: Sequence[float], axes: Sequence[Axis]) -> tuple[float, ...]:
    """Angles in degrees, checked against the largest of every axis."""
    most, result = min(axis.most_deg for axis in axes), tuple(map(float, levels))
    words = ", ".join(f"{level:g}" for level in result) or "none"
    if len(result) < 2 or any(b <= a for a, b in pairwise(result)):
        raise ValueError(f"angles must be two or more that grow, such as 0,30,60; got {words}")
    if result[0] < 0 or result[-1] > most:
        raise ValueError(
            f"angles must lie within 0..{most:g} degrees for {', '.join(axis.name for axis in axes)}, "
            f"got {words}"
        )
    return result


def either_side(level: float) -> tuple[float, ...]:
    """The angle to the one side and to the other; 0 once."""
    return (0.0,) if level == 0 else (-level, level)


def all_angles(axes: Sequence[Axis], levels: Sequence[float]) -> list[tuple[Axis, float]]:
    """Every axis at every level to either side, in the order of a trial's images."""
    return [(axis, angle) for axis in axes for level in levels for angle in either_side(level)]


@dataclass(frozen=True)
class Curve:
    """Tests at growing ``levels`` (degrees), after learning from rows in ordinary light and view.

    ``points`` are the rows tested: first in that light and view, then at each level.
    """

    name: str
    title: str
    learn: Int64[np.ndarray, " n"]
    levels: tuple[float, ...]
    points: tuple[Int64[np.ndarray, " _"], ...]


@dataclass(frozen=True)
class Trial:
    """Images, for training and tests, the targets of these M rows, and a curve for each axis.

    Rows of one ``unit`` (the same face at several angles, the images of one person, a track) are resampled
    together. ``how`` is the source of other lights and views, in words; ``n_dropped`` rows carry no label.
    """

    images: UInt8[np.ndarray, "m 3 s s"]
    task: Task
    unit: Int64[np.ndarray, " m"]
    curves: tuple[Curve, ...]
    how: str
    n_dropped: int = 0

    def __post_init__(self) -> None:
        for curve in self.curves:
            sizes = [len(rows) for rows in curve.points]
            if len(curve.learn) < 5 or 0 in sizes:
                raise ValueError(
                    f"{curve.title}: {len(curve.learn)} rows to learn from and {', '.join(map(str, sizes))} "
                    "to be tested on: five and one are the least; give more images"
                )
            both = np.intersect1d(self.unit[curve.learn], self.unit[np.concatenate(curve.points)])
            if len(both):
                raise ValueError(f"{curve.title}: {len(both)} units would be both learned from and tested")

    @property
    def pictures(self) -> ImageSet:
        """All images, to compute features of."""
        files = tuple(f"{row:06d}" for row in range(len(self.images)))
        return ImageSet(self.images, files, source=self.how)


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

    Rows without a label are neither learned from nor tested.
    """
    test = np.arange(n_learn, len(task))
    shown = np.concatenate((np.arange(len(task)), np.tile(test, len(all_angles(axes, levels)))))
    sides = [len(test) * len(either_side(level)) for _ in axes for level in levels]
    parts = np.split(np.arange(len(shown)), np.cumsum([n_learn, len(test), *sides])[:-1])
    known = task.known[shown]
    learn, ordinary, *tested = (rows[known[rows]] for rows in parts)
    curves = tuple(
        Curve(axis.name, axis.title, learn, levels, (ordinary, *tested[at : at + len(levels)]))
        for axis, at in zip(axes, range(0, len(tested), len(levels)), strict=True)
    )
    return Trial(images, task.select(shown), unit[shown].astype(np.int64), curves, how, n_dropped)
