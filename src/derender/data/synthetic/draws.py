"""Draws that faces and cars share: from uniform numbers of 0..1 to values within settings' ranges."""

from collections.abc import Mapping

import numpy as np
from numpy import ndarray

from derender.data.synthetic.settings import LightSettings, Range

_OTHER_DEG = 20.0  # with beyond_deg, the angle that is not beyond stays within this
_YAW_SHARE = 0.6


def scaled(ends: Range, share: float) -> float:
    """The value at that share of a range."""
    return float(ends[0] + (ends[1] - ends[0]) * share)


def clipped(value: float, ends: Range) -> float:
    """The value of a range that is nearest."""
    return float(min(max(value, ends[0]), ends[1]))


def either_side(ends: Range, beyond: float, share: float) -> float:
    """Uniform over the two pieces of a range that lie at least ``beyond`` from 0."""
    left, right = max(0.0, -beyond - ends[0]), max(0.0, ends[1] - beyond)
    at = share * (left + right)
    return float(ends[0] + at if at < left else beyond + (at - left))


def light_angles(light: LightSettings, uniform: ndarray) -> tuple[float, float]:
    """Pitch and yaw in radians from three uniform numbers: for pitch, for yaw, and which one is beyond."""
    pitch, yaw = scaled(light.pitch_deg, uniform[0]), scaled(light.yaw_deg, uniform[1])
    if light.beyond_deg > 0:
        if uniform[2] < _YAW_SHARE:
            yaw = either_side(light.yaw_deg, light.beyond_deg, uniform[1])
            pitch = _OTHER_DEG * (2.0 * uniform[0] - 1.0)
        else:
            pitch = either_side(light.pitch_deg, light.beyond_deg, uniform[0])
            yaw = _OTHER_DEG * (2.0 * uniform[1] - 1.0)
    return float(np.deg2rad(pitch)), float(np.deg2rad(yaw))


def name_at(shares: Mapping[str, float], at: float) -> str:
    """The name in whose share of the whole a number of 0..1 falls."""
    names = list(shares)
    ends = np.cumsum([shares[name] for name in names])
    return names[int(np.searchsorted(ends, at * ends[-1], side="right"))]
