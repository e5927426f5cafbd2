"""Which way light or camera turn: how each axis is set in a generator, in a scene, and read from labels.

Everything else stays as it was drawn or found: turning the camera leaves the light where it is, turning the
light leaves ambient and diffuse. Angles are degrees here because people write them on axes; 0 is the front.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from derender.data import suggestion
from derender.scene import Scene

LEVELS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
MOST_DEG = 85.0
Fixed = Mapping[str, tuple[float, float]]
"""Ranges of a generator's settings that hold an angle fixed, by name."""


@dataclass(frozen=True)
class Axis:
    """One way to turn light or camera.

    Attributes:
        name: on the command line.
        title: in tables and charts.
        part: of a generator's settings, "view" or "light".
        fixed: by kind of generated picture, the settings of that part for an angle in degrees.
        column: of a scene's camera or light.
        cleared: columns that are set to 0 meanwhile, so that the angle is the whole angle.
        truth: labels (radians) that tell the angle; with two, the angle of a light's direction off the front.
        most_deg: the largest angle that can be set.
    """

    name: str
    title: str
    part: str
    fixed: Mapping[str, Callable[[float], Fixed]]
    column: int
    cleared: tuple[int, ...]
    truth: tuple[str, ...]
    most_deg: float = MOST_DEG

    def turned(self, scene: Scene, angle_deg: float) -> Scene:
        """The scenes with this angle in place of their own; sign as in docs/conventions.md."""
        name = "camera" if self.part == "view" else "light"
        values = scene.parameters[name].clone()
        values[:, list(self.cleared)] = 0
        values[:, self.column] = math.radians(angle_deg)
        return scene.with_parameters(**{name: values})

    def true_deg(self, labels: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) how far off the front the pictures are, in degrees, 0 or more, by their labels.

        Raises:
            ValueError: the labels do not tell.
        """
        absent = [name for name in self.truth if name not in labels]
        if absent:
            raise ValueError(
                f"the true {self.title} is not among the labels (there is no {absent[0]!r}): give rendered "
                "pictures with a params.csv, as derender synth writes them"
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
"""By name on the command line."""


def chosen_axes(names: Sequence[str], kind: str | None = None) -> tuple[Axis, ...]:
    """Axes by name; an unknown one, or one that generated pictures cannot be turned about, is an error."""
    for name in names:
        if name not in AXES:
            raise ValueError(f"no axis {name!r}{suggestion(name, AXES)}: there is {', '.join(AXES)}")
        if kind is not None and kind not in AXES[name].fixed:
            raise ValueError(f"generated {kind} cannot be turned about the axis {name!r}: leave it out")
    if not names:
        raise ValueError(f"name an axis: there is {', '.join(AXES)}")
    return tuple(AXES[name] for name in dict.fromkeys(names))


def checked_levels(levels: Sequence[float], axes: Sequence[Axis]) -> tuple[float, ...]:
    """Angles in degrees, as they are if every axis can be turned so far."""
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


def _words(levels: Sequence[float]) -> str:
    return ", ".join(f"{level:g}" for level in levels) or "none"
