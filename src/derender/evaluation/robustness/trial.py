"""A trial as a value: pictures, what is asked of them, who learns, and who is tested at which angle.

Every curve names rows of one stack of pictures, so that features are made once for all of it. Leaves out
where pictures come from and every score.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int64, UInt8

from derender.data import PictureSet
from derender.evaluation.linear_task import Task


@dataclass(frozen=True)
class Curve:
    """Tests at growing angles, after learning from the same rows.

    Attributes:
        name, title: of the axis.
        learn: (n,) rows that are learned from: ordinary light and view.
        ordinary: (t,) rows tested in ordinary light and view.
        levels: (L,) angles in degrees, growing.
        tested: for every level, its rows; none of the units that learned is among them.
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
    """Everything a probe is asked.

    Attributes:
        images: (M, 3, S, S) all pictures, learned from and tested.
        task: what is asked of the M rows.
        unit: (M,) what is drawn again in resamples: rows of one unit (the same face turned to several
            angles, the pictures of one person, a track) come and go together.
        curves: one for each axis.
        how: where other lights and views come from, in words.
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
                f"a trial needs a target and a unit for every picture, got {len(self.images)} pictures, "
                f"{len(self.task)} targets and {len(self.unit)} units"
            )
        for curve in self.curves:
            if len(curve.levels) != len(curve.tested) or any(b <= a for a, b in pairwise(curve.levels)):
                raise ValueError(f"curve {curve.name!r} needs growing angles with rows for each")
            if len(curve.learn) < 5 or not all(len(rows) for rows in curve.points):
                raise ValueError(
                    f"{curve.title}: {len(curve.learn)} rows to learn from and "
                    f"{', '.join(str(len(rows)) for rows in curve.points)} to be tested on: five and one "
                    "are the least; give more pictures"
                )
            both = np.intersect1d(self.unit[curve.learn], self.unit[np.concatenate(curve.points)])
            if len(both):
                raise ValueError(f"{curve.title}: {len(both)} units would be both learned from and tested")

    @property
    def pictures(self) -> PictureSet:
        """All pictures, for whoever makes features of them."""
        return PictureSet(
            self.images, tuple(f"{row:06d}" for row in range(len(self.images))), source=self.how
        )

    @property
    def learned(self) -> np.ndarray:
        """Rows that any curve learns from."""
        return np.unique(np.concatenate([curve.learn for curve in self.curves]))
