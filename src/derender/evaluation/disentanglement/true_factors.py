"""The true factors that the labels of a rendered set hold, and which feature each of them belongs to.

Numbers stay numbers (light, camera), names become classes (identity, expression, kind of car). Leaves out
labels that no scene is made of (age, track, frame) and everything that a set of real pictures is labelled
with.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from derender.features import missing

# label: (name shown, features that it belongs to)
_KNOWN = {
    "ambient": ("ambient", ("light",)),
    "diffuse": ("diffuse", ("light",)),
    "light_pitch_rad": ("light pitch", ("light",)),
    "light_yaw_rad": ("light yaw", ("light",)),
    "camera_x_rad": ("camera pitch", ("camera",)),
    "camera_y_rad": ("camera yaw", ("camera",)),
    "camera_z_rad": ("camera roll", ("camera",)),
    "camera_tx": ("shift x", ("camera",)),
    "camera_ty": ("shift y", ("camera",)),
    "elevation_rad": ("elevation", ("camera",)),
    "azimuth_rad": ("azimuth", ("camera",)),
    "identity": ("identity", ("geometry", "albedo")),
    "expression": ("expression", ("geometry", "albedo")),
    "class": ("class", ("geometry", "albedo")),
}


@dataclass(frozen=True)
class TrueFactor:
    """One factor that pictures were made from.

    Attributes:
        name: as shown.
        values: (N,) float64 numbers, or integers from 0 for classes.
        is_class: whether the values are classes.
        belongs_to: names of the features that ought to hold it.
    """

    name: str
    values: np.ndarray
    is_class: bool
    belongs_to: tuple[str, ...] = ()

    def targets(self) -> np.ndarray:
        """What a regression fits: (N, 1) numbers, or (N, classes) zeros and ones."""
        if not self.is_class:
            return self.values[:, None].astype(np.float64)
        return np.eye(int(self.values.max()) + 1)[self.values]

    def select(self, rows: np.ndarray) -> "TrueFactor":
        """The same factor of some rows; classes that have gone are counted no more."""
        values = self.values[rows]
        values = np.unique(values, return_inverse=True)[1] if self.is_class else values
        return TrueFactor(self.name, values, self.is_class, self.belongs_to)


def true_factors(labels: Mapping[str, np.ndarray]) -> list[TrueFactor]:
    """The labels that are factors of a rendered scene, in a fixed order; empty for real pictures.

    A column is left out when a value is missing or all are the same, and a class column also when it has more
    classes than a fifth of the rows: such classes are names of single pictures. Unless a column of light or
    camera is there, the set is not a rendered one and nothing is given.
    """
    found = [one for label in _KNOWN if isinstance(one := _read(labels, label), TrueFactor)]
    return found if any(not factor.is_class for factor in found) else []


def left_out(labels: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The factors of a rendered scene that are among the labels and left out by ``true_factors``, and why."""
    if not true_factors(labels):
        return {}
    return {_KNOWN[label][0]: one for label in _KNOWN if isinstance(one := _read(labels, label), str)}


def _read(labels: Mapping[str, np.ndarray], label: str) -> TrueFactor | str | None:
    """The factor that a label holds, or why it is left out; None where there is no such label."""
    if label not in labels:
        return None
    name, features = _KNOWN[label]
    if absent := int(missing(labels[label]).sum()):
        return f"{absent:,} of {len(labels[label]):,} values are missing"
    values = np.asarray(labels[label])
    if values.dtype.kind == "f":
        if np.ptp(values) > 1e-9:
            return TrueFactor(name, values.astype(np.float64), False, features)
        return "one value for all pictures"
    classes = np.unique(values.astype(str), return_inverse=True)[1]
    count = int(classes.max()) + 1
    if 2 <= count <= len(values) / 5:
        return TrueFactor(name, classes, True, features)
    return "one class only" if count < 2 else f"{count:,} classes of {len(values):,} pictures"
