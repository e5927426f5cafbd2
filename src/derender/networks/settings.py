"""Sizes of the networks."""

from typing import Literal

from pydantic import Field, field_validator

from derender.settings import Settings

IMAGE_SIZES = (32, 64, 128, 256)


class NetworkSettings(Settings):
    """Sizes of the networks; the defaults are the paper's.

    The geometry and albedo nets start at ``width`` channels and double to 8x that; light and camera
    start at ``light_width``. ``unet_width`` counts only where ``encoder`` is "unet"; ``unet_decoder`` says
    that a decoder over the U-Nets of geometry and albedo comes along, which ``derender unet`` teaches.
    """

    image_size: int = 64
    width: int = Field(default=64, ge=4, multiple_of=4)
    light_width: int = Field(default=32, ge=1)
    code_size: int = Field(default=256, ge=1)
    confidence_code_size: int = Field(default=128, ge=1)
    encoder: Literal["conv", "unet"] = "conv"
    unet_width: int = Field(default=16, ge=1)
    unet_decoder: bool = False

    @field_validator("image_size")
    @classmethod
    def _power_of_two(cls, value: int) -> int:
        if value not in IMAGE_SIZES:
            raise ValueError(f"image_size must be one of {', '.join(map(str, IMAGE_SIZES))}, got {value}")
        return value

    @property
    def stages(self) -> int:
        """How many halvings take a picture to 4x4 pixels."""
        return self.image_size.bit_length() - 3
