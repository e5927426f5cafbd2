"""What a page may ask: which picture, which factors from another one, which light and view, how large.

Every number has bounds and every name a pattern; whatever else is sent is refused. Nothing here can name a
file. Angles are degrees, since people read them; ``light_row`` and ``camera_row`` give radians.
"""

from math import degrees, radians
from typing import Annotated, Literal, TypeVar

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from derender.report.viewer.refused import Refused

LARGEST_SIZE = 512
SWAPPED = ("geometry", "albedo")
"""Factors that are taken from another picture by its name; light and camera travel as numbers."""

PictureId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{22}$")]
Angle = Annotated[float, Field(ge=-89, le=89)]
Strength = Annotated[float, Field(ge=0, le=2)]
Shift = Annotated[float, Field(ge=-0.5, le=0.5)]


class _Asked(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class Light(_Asked):
    """Ambient and diffuse strength, pitch and yaw in degrees (conventions.md)."""

    ambient: Strength
    diffuse: Strength
    pitch_deg: Angle
    yaw_deg: Angle

    @classmethod
    def of(cls, light: Float[Tensor, "4"]) -> "Light":
        ambient, diffuse, pitch, yaw = light.tolist()
        return cls(ambient=ambient, diffuse=diffuse, pitch_deg=degrees(pitch), yaw_deg=degrees(yaw))

    def light_row(self) -> Float[Tensor, "1 4"]:
        return torch.tensor([[self.ambient, self.diffuse, radians(self.pitch_deg), radians(self.yaw_deg)]])


class Camera(_Asked):
    """Rotation about x, y, z in degrees and translation in scene units (conventions.md)."""

    rotation_deg: Annotated[list[Angle], Field(min_length=3, max_length=3)]
    translation: Annotated[list[Shift], Field(min_length=3, max_length=3)]

    @classmethod
    def of(cls, camera: Float[Tensor, "6"]) -> "Camera":
        numbers = camera.tolist()
        return cls(rotation_deg=[degrees(angle) for angle in numbers[:3]], translation=numbers[3:])

    def camera_row(self) -> Float[Tensor, "1 6"]:
        return torch.tensor([[*map(radians, self.rotation_deg), *self.translation]])


class Question(_Asked):
    """A picture as it is to be shown.

    Attributes:
        picture: the name it got when it was opened.
        swaps: other opened pictures that give their geometry or albedo.
        light: instead of the picture's own.
        camera: instead of the picture's own.
        size: side in pixels; the model's own if left out, and never less.
    """

    picture: PictureId
    swaps: dict[Literal["geometry", "albedo"], PictureId] = {}
    light: Light | None = None
    camera: Camera | None = None
    size: Annotated[int, Field(ge=8, le=LARGEST_SIZE)] | None = None


class NeighbourQuestion(Question):
    """A picture whose nearest rows are wanted, by one factor."""

    factor: Annotated[str, Field(max_length=64)]
    k: Annotated[int, Field(ge=1, le=48)] = 12


Q = TypeVar("Q", bound=_Asked)


def read_question(kind: type[Q], body: bytes) -> Q:
    """The question in a request's body; anything else is refused with the first thing that is wrong."""
    try:
        return kind.model_validate_json(body)
    except ValidationError as problem:
        first = problem.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"])) or "the request"
        raise Refused(422, f"{where}: {first['msg']}") from problem
