"""Which views, lights and expressions generated pictures show; defaults follow the rendered development set.

Angles are degrees because people write settings; radians everywhere else. A setting changes only what it
names: the random numbers behind each picture do not depend on it, so the same seed shows the same people in
another light. ``LIGHTS`` and ``VIEWS`` name whole sets of them: "wide" is outside what "usual" ever shows.
"""

from collections.abc import Iterable, Mapping
from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator

from derender.data.synthetic.face_expression import EXPRESSIONS
from derender.settings import Settings

Range = tuple[float, float]
BACKGROUNDS = ("plain", "gradient", "noise")


def check_range(name: str, value: Range, low: float, high: float) -> None:
    """Raise ValueError unless the range lies within low..high."""
    if not low <= value[0] <= value[1] <= high:
        raise ValueError(f"{name} must be two numbers, low <= high, within {low}..{high}; got {value}")


def check_names(name: str, values: Iterable[str], known: Iterable[str]) -> None:
    """Raise ValueError unless there are names and all are known."""
    if not set(values) or not set(values) <= set(known):
        raise ValueError(f"{name} must be one or more of {', '.join(known)}; got {tuple(values)}")


def check_shares(name: str, shares: Mapping[str, float], known: Iterable[str]) -> None:
    """Raise ValueError unless known names have shares of 0 or more, at least one of them above."""
    check_names(name, shares, known)
    if min(shares.values()) < 0 or sum(shares.values()) <= 0:
        raise ValueError(f"{name}: shares must be 0 or more and not all 0, got {dict(shares)}")


def check_beyond(name: str, beyond: float, ends: Range) -> None:
    """Raise ValueError unless an angle above 0 lies within a range on both sides of 0."""
    if beyond > 0 and not ends[0] <= -beyond <= beyond <= ends[1]:
        kind = name.replace("_beyond", "")
        raise ValueError(f"{name} must lie within {kind} {ends} on both sides, got {beyond}")


def equal_shares(value: object) -> object:
    """A list of names means equal shares."""
    return dict.fromkeys(value, 1.0) if isinstance(value, (list, tuple)) else value


Shares = Annotated[Mapping[str, float], BeforeValidator(equal_shares)]


class LightSettings(Settings):
    """Uniform ranges. With ``beyond_deg`` either yaw or pitch (60 : 40) is at least so far off the front, on
    either side, and the other at most 20 degrees."""

    yaw_deg: Range = (-45.0, 45.0)
    pitch_deg: Range = (-45.0, 45.0)
    beyond_deg: float = Field(default=0.0, ge=0, lt=85)
    ambient: Range = (0.25, 0.7)
    diffuse: Range = (0.2, 0.8)

    @model_validator(mode="after")
    def _possible(self) -> "LightSettings":
        for name, low, high in (
            ("yaw_deg", -85, 85),
            ("pitch_deg", -85, 85),
            ("ambient", 0, 1),
            ("diffuse", 0, 1),
        ):
            check_range(f"light.{name}", getattr(self, name), low, high)
        return self


class ViewSettings(Settings):
    """Ranges of the camera's angles. A spread (``*_sd_deg``) draws a normal about the middle of the range,
    clipped at its ends; without one (null) the range is uniform. With ``yaw_beyond_deg`` yaw is uniform on
    either side, from there to the range's ends."""

    yaw_deg: Range = (-45.0, 45.0)
    yaw_sd_deg: float | None = Field(default=18.0, ge=0, le=90)
    yaw_beyond_deg: float = Field(default=0.0, ge=0, lt=90)
    pitch_deg: Range = (-20.0, 20.0)
    pitch_sd_deg: float | None = Field(default=8.0, ge=0, le=90)
    roll_deg: Range = (-12.0, 12.0)
    roll_sd_deg: float | None = Field(default=4.0, ge=0, le=90)
    shift: Range = (-0.008, 0.008)  # scene units, right and down; one pixel of 64 is 0.0028
    shift_sd: float | None = Field(default=0.0035, ge=0, le=0.1)

    @model_validator(mode="after")
    def _possible(self) -> "ViewSettings":
        for name, limit in (("yaw_deg", 90.0), ("pitch_deg", 60.0), ("roll_deg", 180.0), ("shift", 0.1)):
            check_range(f"view.{name}", getattr(self, name), -limit, limit)
        check_beyond("view.yaw_beyond_deg", self.yaw_beyond_deg, self.yaw_deg)
        return self


LIGHTS: Mapping[str, LightSettings] = {
    "usual": LightSettings(),
    "wide": LightSettings(
        yaw_deg=(-70, 70), pitch_deg=(-60, 60), beyond_deg=35, ambient=(0.05, 0.3), diffuse=(0.6, 1.0)
    ),
    "frontal": LightSettings(yaw_deg=(0, 0), pitch_deg=(0, 0), ambient=(0.45, 0.45), diffuse=(0.5, 0.5)),
}
VIEWS: Mapping[str, ViewSettings] = {
    "usual": ViewSettings(),
    "wide": ViewSettings(yaw_deg=(-60, 60), yaw_beyond_deg=20),
    "frontal": ViewSettings(yaw_sd_deg=0, pitch_sd_deg=0, roll_sd_deg=0, shift_sd=0),
}


class FaceSettings(Settings):
    """Everything that may be asked of generated faces.

    With ``tracks`` (per identity) pictures come as sequences of ``frames``: light and background stay, head
    and expression move smoothly; otherwise an identity has ``pictures_per_identity`` pictures.
    """

    light: LightSettings = LightSettings()
    view: ViewSettings = ViewSettings()
    pictures_per_identity: int = Field(default=8, ge=1)
    first_identity: int = Field(default=0, ge=0)  # other people from the same seed
    tracks: int = Field(default=0, ge=0)
    frames: int = Field(default=6, ge=1)
    expressions: Shares = Field(default=dict.fromkeys(EXPRESSIONS, 1.0))  # name: share
    strength: Range = (0.4, 1.05)
    asymmetry: float = Field(default=0.12, ge=0, le=1)  # sd by which the two halves of an expression differ
    gaze_px: float = Field(default=0.6, ge=0, le=3)  # sd of the irises' shift
    age_years: Range = (18.0, 80.0)
    skin_tone: Range = (0.0, 1.0)  # 0 fair .. 1 dark
    backgrounds: tuple[str, ...] = BACKGROUNDS

    @model_validator(mode="after")
    def _possible(self) -> "FaceSettings":
        for name, low, high in (("strength", 0.0, 1.5), ("age_years", 16.0, 100.0), ("skin_tone", 0.0, 1.0)):
            check_range(name, getattr(self, name), low, high)
        check_shares("expressions", self.expressions, EXPRESSIONS)
        check_names("backgrounds", self.backgrounds, BACKGROUNDS)
        return self

    @property
    def per_identity(self) -> int:
        """How many consecutive pictures show one person."""
        return self.tracks * self.frames or self.pictures_per_identity
