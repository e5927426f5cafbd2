"""Requests of the page, checked: image, factors of another image, light, camera, size; uploads to pixels.

Every number has bounds and every name a pattern; anything else is refused. Nothing here can name a file. An
upload is decoded by its content, never by name or stated type (data/decode.py, with tighter bounds than a
data set needs). Angles are degrees here; ``light_row`` and ``camera_row`` give radians.
"""

from collections.abc import Callable
from math import degrees, radians
from typing import Annotated, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL.Image import DecompressionBombError
from pydantic import Field, ValidationError
from torch import Tensor

from derender.data import Unreadable, decode, decode_whole, quiet_pillow
from derender.settings import Settings

LARGEST_SIZE = 1024
BODY_LIMIT_BYTES = 20_000_000
PIXEL_LIMIT = 40_000_000  # fewer than any decompression bomb needs, more than most cameras take

KINDS = "JPEG, PNG, WebP, AVIF, BMP, GIF, TIFF, PPM"

ImageId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{22}$")]
STRONGEST, FARTHEST, STEEPEST_DEG = 2.0, 2.0, 89.0
Angle = Annotated[float, Field(ge=-STEEPEST_DEG, le=STEEPEST_DEG)]
Strength = Annotated[float, Field(ge=0, le=STRONGEST)]
Shift = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]


class Refused(Exception):
    """A request that is not granted: an HTTP status, and the reason and the remedy in one sentence."""

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status, self.message = status, message


class Light(Settings):
    """Ambient and diffuse strength, pitch and yaw in degrees (conventions.md)."""

    ambient: Strength
    diffuse: Strength
    pitch_deg: Angle
    yaw_deg: Angle

    @classmethod
    def of(cls, light: Float[Tensor, "4"]) -> "Light":
        """The nearest that the page can ask for: a model may have wider ranges."""
        ambient, diffuse = light[:2].nan_to_num().clamp(0, STRONGEST).tolist()
        pitch_deg, yaw_deg = _degrees(light[2:])
        return cls(ambient=ambient, diffuse=diffuse, pitch_deg=pitch_deg, yaw_deg=yaw_deg)

    def light_row(self) -> Float[Tensor, "1 4"]:
        return torch.tensor([[self.ambient, self.diffuse, radians(self.pitch_deg), radians(self.yaw_deg)]])


class Camera(Settings):
    """Rotation about x, y, z in degrees and translation in scene units (conventions.md)."""

    rotation_deg: Annotated[list[Angle], Field(min_length=3, max_length=3)]
    translation: Annotated[list[Shift], Field(min_length=3, max_length=3)]

    @classmethod
    def of(cls, camera: Float[Tensor, "6"]) -> "Camera":
        """The nearest that the page can ask for."""
        shifts = camera[3:].nan_to_num().clamp(-FARTHEST, FARTHEST).tolist()
        return cls(rotation_deg=_degrees(camera[:3]), translation=shifts)

    def camera_row(self) -> Float[Tensor, "1 6"]:
        return torch.tensor([[*map(radians, self.rotation_deg), *self.translation]])


def _degrees(angles: Float[Tensor, " k"]) -> list[float]:
    return [min(max(degrees(one), -STEEPEST_DEG), STEEPEST_DEG) for one in angles.nan_to_num().tolist()]


class ViewRequest(Settings):
    """An image as it is to be shown."""

    picture: ImageId  # the name it got when it was opened
    # other opened images that give their geometry, albedo or light
    swaps: dict[Literal["geometry", "albedo", "light"], ImageId] = Field(default_factory=dict)
    light: Light | None = None  # instead of the image's own
    camera: Camera | None = None  # instead of the image's own
    # of the renderer's further factors, instead of the image's own
    numbers: dict[str, list[float]] = Field(default_factory=dict)
    # longer side in pixels; the model's own if left out, and never less
    size: Annotated[int, Field(ge=8, le=LARGEST_SIZE)] | None = None
    detail: Literal["photo", "model"] = "photo"  # whose pixels are drawn, the photograph's or the model's
    whole: bool = False  # all of the photograph, not only the part around the crop


class FilmRequest(ViewRequest):
    """A film of an image: the light goes round, or the view goes from side to side."""

    kind: Literal["gif", "mp4"]
    move: Literal["light", "camera"]


class Place(Settings):
    """A square in the photograph: its centre and side in pixels, its clockwise turn in degrees."""

    x: Annotated[float, Field(ge=0, le=PIXEL_LIMIT)]
    y: Annotated[float, Field(ge=0, le=PIXEL_LIMIT)]
    side: Annotated[float, Field(ge=8, le=PIXEL_LIMIT)]
    roll_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0


class CropRequest(Settings):
    """An opened image to be decomposed again, with its scene optimised against it or not.

    ``crop`` is the part that the model is given, or how it is found; the same as before if left out.
    """

    picture: ImageId
    crop: Place | Literal["face", "auto", "none"] | None = None
    fit: bool = False


class NeighbourRequest(ViewRequest):
    """An image whose nearest rows are requested, by one factor."""

    factor: Annotated[str, Field(max_length=64)]
    k: Annotated[int, Field(ge=1, le=48)] = 12


Question = TypeVar("Question", bound=Settings)


def read_request(kind: type[Question], body: bytes) -> Question:
    """The question in a request's body, of the stated types; anything else is refused: its first mistake."""
    try:
        return kind.model_validate_json(body, strict=True)
    except ValidationError as problem:
        first = problem.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"])) or "the request"
        raise Refused(422, f"{where}: {first['msg']}") from problem


def too_large() -> Refused:
    return Refused(413, f"this file is larger than {BODY_LIMIT_BYTES // 10**6} MB: make it smaller first")


def pixels_of(
    encoded: bytes, image_size: int, box: np.ndarray | None = None, fit: str = "crop"
) -> UInt8[np.ndarray, "3 s s"]:
    """Decode one image, by default its centre square; ``Refused`` (413 or 415) if that is impossible."""
    return _decoded(encoded, lambda: decode(encoded, image_size, fit, box, PIXEL_LIMIT))


def photo_of(encoded: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Decode one image at its own size; ``Refused`` as `pixels_of` is."""
    return _decoded(encoded, lambda: decode_whole(encoded, PIXEL_LIMIT))


def _decoded(encoded: bytes, decoder: Callable[[], np.ndarray]) -> np.ndarray:
    if len(encoded) > BODY_LIMIT_BYTES:
        raise too_large()
    if not encoded:
        raise Refused(415, f"this file is empty: choose an image ({KINDS})")
    try:
        with quiet_pillow():
            return decoder()
    except Unreadable as problem:
        if "million pixels" in str(problem) or isinstance(problem.__cause__, DecompressionBombError):
            most = f"{PIXEL_LIMIT // 10**6} million pixels"
            raise Refused(413, f"this image has more than {most}: make it smaller first") from problem
        reason = f"this file cannot be read: {' '.join(str(problem).split())[:200]}"
        raise Refused(415, f"{reason}; whatever its name, choose an image ({KINDS})") from problem
