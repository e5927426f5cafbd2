"""Eyes and the inside of the mouth, painted picture by picture over the skin's albedo.

Lids follow the expression, irises the gaze; the mouth's inside shows teeth, dark and tongue as far as the
lips have parted. Colours only: no highlights, since albedo holds no light.
"""

from typing import no_type_check

import numpy as np

from derender.data import MASK_CLASSES
from derender.data.synthetic.face_grid import EYE_P, EYE_Q, MOUTH_BAND, MOUTH_Q
from derender.render.numba_threads import kernel

_LASH = (0.10, 0.07, 0.06)
_SCLERA = (0.86, 0.83, 0.81)
_PINK = (0.74, 0.45, 0.42)
_PUPIL = (0.02, 0.02, 0.02)
_TOOTH = (0.87, 0.83, 0.76)
_DARK = (0.15, 0.05, 0.05)
_TONGUE = (0.60, 0.26, 0.25)
_LEFT_EYE, _RIGHT_EYE, _MOUTH = (np.uint8(MASK_CLASSES.index(name)) for name in ("l_eye", "r_eye", "mouth"))
_IRIS_RADIUS, _PUPIL_RADIUS = 2.4, 1.0


@kernel
@no_type_check
def paint_features(albedo, parts, p, q, gap, eyes, iris, lips, gaze):
    """Paint in place, one face per row.

    albedo (N,R,C,3); parts (N,R,C) uint8, set where eyes and the mouth's inside show; p (C,) and q (R,)
    domain coordinates; gap (N,C) by how much the lips have parted, face pixels; eyes (N,8): half length,
    upper and lower opening of the eye at p < 0, then of the eye at p > 0, tilt, lashes, crease; iris, lips
    (N,3); gaze (N,2), face pixels.
    """
    for n in range(albedo.shape[0]):
        for r in range(len(q)):
            near_eye = abs(q[r] - EYE_Q) < 7.0
            in_mouth = abs(q[r] - MOUTH_Q) < 1.1 * MOUTH_BAND
            if not (near_eye or in_mouth):
                continue
            for c in range(len(p)):
                beside = near_eye and abs(abs(p[c]) - EYE_P) < 8.0
                part = parts[n, r, c : c + 1]
                if beside:
                    _paint_eye(albedo[n, r, c], part, p[c], q[r] - EYE_Q, eyes[n], iris[n], gaze[n])
                if in_mouth and abs(p[c]) < 9.3:
                    across = (q[r] - MOUTH_Q) / MOUTH_BAND
                    _paint_mouth(albedo[n, r, c], part, p[c], across, gap[n, c], lips[n])


@kernel
@no_type_check
def _paint_eye(colour, part, p, y, eye, iris, gaze):
    side = 1.0 if p > 0.0 else -1.0
    up, low = (eye[3], eye[4]) if side > 0 else (eye[1], eye[2])
    length, tilt, lashes, crease = eye[0], eye[5], eye[6], eye[7]
    outward = side * p - EYE_P
    level = y + tilt * outward
    along = outward / length
    body = max(1.0 - along * along, 0.0)
    below_upper = level + up * body**0.75 * (1.0 - 0.12 * along)  # > 0 below the upper lid's edge
    above_lower = low * body**0.9 * (1.0 + 0.15 * along) - level
    fold = np.exp(-0.5 * ((below_upper + 1.5) / 0.42) ** 2) * np.exp(-((outward / (1.05 * length)) ** 4))
    lid = np.exp(-0.5 * ((below_upper + 0.9) / 0.9) ** 2) * np.exp(-((outward / (1.1 * length)) ** 4))
    for k in range(3):
        colour[k] *= (1.0 - 0.28 * crease * fold) * (1.0 - 0.10 * lid)
    inside = 0.0
    if body > 0.0:
        inside = min(below_upper, above_lower) / 0.45 + 0.5
        if inside > 0.0:
            x, v = p - side * EYE_P - gaze[0], level - gaze[1] + 0.55
            _paint_eyeball(colour, inside, np.sqrt(x * x + v * v), below_upper, along, iris)
    thick = 0.40 + 0.20 * lashes * (1.0 + 0.6 * along)
    lash = np.exp(-(((below_upper + 0.15) / thick) ** 2)) * np.exp(-((outward / (1.02 * length)) ** 8))
    rim = np.exp(-(((above_lower + 0.1) / 0.4) ** 2)) * np.exp(-((outward / (0.95 * length)) ** 8))
    for k in range(3):
        colour[k] = _mixed(colour[k], _LASH[k], 0.95 * lashes * lash)
        colour[k] = _mixed(colour[k], _LASH[k], 0.28 * lashes * rim)
    if inside > 0.5:
        part[0] = _LEFT_EYE if p > 0.0 else _RIGHT_EYE


@kernel
@no_type_check
def _paint_eyeball(colour, inside, distance, below_upper, along, iris):
    shade = (1.0 - 0.28 * np.exp(-max(below_upper, 0.0) / 0.7)) * (1.0 - 0.12 * abs(along))
    rim = 1.15 - 0.75 * min(max((distance - _IRIS_RADIUS + 0.7) / 0.55, 0.0), 1.0)
    for k in range(3):
        value = _mixed(_SCLERA[k] * shade, _PINK[k], 1.6 * (-along - 0.62))
        ring = _mixed(iris[k] * rim, _PUPIL[k], (_PUPIL_RADIUS - distance) / 0.35 + 0.5)
        value = _mixed(value, ring, (_IRIS_RADIUS - distance) / 0.4 + 0.5)
        colour[k] = _mixed(colour[k], value, inside)


@kernel
@no_type_check
def _paint_mouth(colour, part, p, across, gap, lips):
    """``across`` runs from -1 (upper lip's edge) to 1 (lower lip's edge)."""
    lens = np.sqrt(max(1.0 - (p / 9.3) ** 2, 0.0))
    below = 0.5 * (across + 1.0) * gap
    groove = 1.0 - 0.12 * np.exp(-(((p - 1.9 * np.round(p / 1.9)) / 0.25) ** 2))
    tongue = (2.2 * lens - (gap - below)) * min(max((gap - 4.0) / 2.0, 0.0), 1.0)
    teeth = (
        min((2.7 - below) / 0.4 + 0.5, 1.0)
        * (1.0 - 0.5 * (p / 8.0) ** 2)
        * min(max(gap - 0.9, 0.0) / 0.9, 1.0)
    )
    parted = min(max((gap - 0.8) / 0.7, 0.0), 1.0)
    cover = (1.08 - abs(across)) / 0.25 * min(lens * 2.5, 1.0) * (0.85 + 0.15 * parted)
    for k in range(3):
        value = _mixed(_mixed(_DARK[k], _TONGUE[k], tongue), _TOOTH[k] * groove, teeth)
        colour[k] = _mixed(colour[k], _mixed(0.38 * lips[k], value, parted), cover)
    if cover > 0.5 and parted > 0.5:
        part[0] = _MOUTH


@kernel
@no_type_check
def _mixed(value, other, alpha):
    return value + (other - value) * min(max(alpha, 0.0), 1.0)
