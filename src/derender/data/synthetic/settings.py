"""Which views, lights and expressions generated faces show; defaults follow the rendered development set.

Angles are degrees because people write settings; radians everywhere else. A setting changes only what it
names: the random numbers behind each picture do not depend on it, so the same seed shows the same people in
another light.
"""

from pydantic import Field, field_validator, model_validator

from derender.data.synthetic.face_expression import EXPRESSIONS
from derender.settings import Settings


class FaceSettings(Settings):
    """Distributions: ``*_sd_deg`` of a normal clipped at ``*_limit_deg``; pairs are the ends of a uniform."""

    pictures_per_identity: int = Field(default=8, ge=1)
    yaw_mean_deg: float = Field(default=0.0, ge=-90, le=90)
    yaw_sd_deg: float = Field(default=18.0, ge=0, le=90)
    yaw_limit_deg: float = Field(default=45.0, ge=0, le=90)
    pitch_mean_deg: float = Field(default=0.0, ge=-60, le=60)
    pitch_sd_deg: float = Field(default=8.0, ge=0, le=60)
    pitch_limit_deg: float = Field(default=20.0, ge=0, le=60)
    roll_sd_deg: float = Field(default=4.0, ge=0, le=90)
    roll_limit_deg: float = Field(default=12.0, ge=0, le=90)
    translation_sd: float = Field(default=0.0035, ge=0, le=0.1)  # scene units; one pixel of 64 is 0.0028
    translation_limit: float = Field(default=0.008, ge=0, le=0.1)
    light_pitch_deg: tuple[float, float] = (-45.0, 45.0)
    light_yaw_deg: tuple[float, float] = (-45.0, 45.0)
    ambient: tuple[float, float] = (0.25, 0.7)
    diffuse: tuple[float, float] = (0.2, 0.8)
    expressions: tuple[str, ...] = tuple(EXPRESSIONS)  # drawn with equal chance
    strength: tuple[float, float] = (0.4, 1.05)
    asymmetry: float = Field(default=0.12, ge=0, le=1)  # sd by which the two halves of an expression differ
    gaze_px: float = Field(default=0.6, ge=0, le=3)  # sd of the irises' shift
    backgrounds: tuple[str, ...] = ("plain", "gradient", "noise")

    @field_validator("light_pitch_deg", "light_yaw_deg", "ambient", "diffuse", "strength")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] > value[1]:
            raise ValueError(f"expected (low, high) with low <= high, got {value}")
        return value

    @model_validator(mode="after")
    def _possible(self) -> "FaceSettings":
        for name in ("light_pitch_deg", "light_yaw_deg"):
            if max(map(abs, getattr(self, name))) >= 90:
                raise ValueError(f"{name} must lie within (-90, 90), got {getattr(self, name)}")
        for name, top in (("ambient", 1.0), ("diffuse", 1.0), ("strength", 1.5)):
            low, high = getattr(self, name)
            if low < 0 or high > top:
                raise ValueError(f"{name} must lie within 0..{top}, got ({low}, {high})")
        _known("expressions", self.expressions, tuple(EXPRESSIONS))
        _known("backgrounds", self.backgrounds, ("plain", "gradient", "noise"))
        return self


def _known(name: str, values: tuple[str, ...], known: tuple[str, ...]) -> None:
    if not values or not set(values) <= set(known):
        raise ValueError(f"{name} must be one or more of {', '.join(known)}; got {values}")
