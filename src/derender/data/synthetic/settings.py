"""Which views, lighting and objects generated images show, and how settings' ranges turn into drawn values.

Defaults follow the sets `synface` and `syncar`. Angles are degrees because people write settings; radians
everywhere else. A setting changes only what it names: the random numbers behind each image do not depend on
it, so the same seed shows the same people in another light. ``LIGHTS``, ``VIEWS``, ``CAR_LIGHTS`` and
``CAR_VIEWS`` name whole sets of them: "wide" is outside what "usual" ever shows.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy import ndarray
from pydantic import AfterValidator, BeforeValidator, Field

from derender.data.synthetic.lighting import TEXELS, Lighting
from derender.overrides import with_changes
from derender.settings import Settings
from derender.storage.bounded import table_beside
from derender.storage.places import require_known

Kind = TypeVar("Kind", bound=Settings)
Range = tuple[float, float]
BACKGROUNDS = ("plain", "gradient", "noise")
_OTHER_DEG = 20.0  # with beyond_deg, the angle that is not beyond stays within this
_YAW_SHARE = 0.6


@lru_cache(maxsize=2)
def numbers_of(kind: str) -> dict[str, Any]:
    """The tables in ``faces.yaml`` or ``cars.yaml``."""
    return table_beside(__file__, f"{kind}.yaml")


EXPRESSIONS: dict[str, dict[str, float]] = numbers_of("faces")["expressions"]
CLASSES: dict[str, list[str]] = numbers_of("cars")["classes"]  # body styles of each class of cars


def drawn(ends: Range, share: float, beyond: float = 0.0) -> float:
    """The value at that share of a range, or of its two pieces that lie at least ``beyond`` from 0."""
    if beyond <= 0.0:
        return float(ends[0] + (ends[1] - ends[0]) * share)
    left, right = max(0.0, -beyond - ends[0]), max(0.0, ends[1] - beyond)
    at = share * (left + right)
    return float(ends[0] + at if at < left else beyond + (at - left))


def pick(weights: Sequence[float] | ndarray, at: float) -> int:
    """The number in whose share of the whole a number of 0..1 falls."""
    ends = np.cumsum(weights)
    return min(int(np.searchsorted(ends, at * ends[-1], side="right")), len(ends) - 1)


def _within(low: float, high: float) -> AfterValidator:
    """Of a range: that it ascends and lies within these limits."""

    def check(ends: Range) -> Range:
        if not low <= ends[0] <= ends[1] <= high:
            raise ValueError(f"must be two numbers, low <= high, within {low:g}..{high:g}; got {ends}")
        return ends

    return AfterValidator(check)


def _inside(name: str) -> AfterValidator:
    """Of an angle: that the range of this name reaches beyond it on both sides."""

    def check(value: float, info: Any) -> float:
        ends = info.data.get(name)
        if ends is not None and value > 0 and not ends[0] <= -value <= value <= ends[1]:
            raise ValueError(f"must lie within {name} {ends} on both sides, got {value}")
        return value

    return AfterValidator(check)


def _among(known: Iterable[str]) -> AfterValidator:
    """Of names, which may have shares: that all are known, and that some share is not 0."""

    def check(value: Any) -> Any:
        if not set(value) or not set(value) <= set(known):
            raise ValueError(f"must be one or more of {', '.join(known)}; got {tuple(value)}")
        if isinstance(value, Mapping) and (min(value.values()) < 0 or sum(value.values()) <= 0):
            raise ValueError(f"shares must be 0 or more and not all 0, got {dict(value)}")
        return value

    return AfterValidator(check)


Shares = Annotated[  # a list of names means equal shares
    Mapping[str, float],
    BeforeValidator(lambda v: dict.fromkeys(v, 1.0) if isinstance(v, (list, tuple)) else v),
]
Angles = Annotated[Range, _within(-180, 180)]
LampAngles = Annotated[Range, _within(-85, 85)]
Share = Annotated[Range, _within(0, 1)]
Shift = Annotated[Range, _within(-0.1, 0.1)]
Backgrounds = Annotated[tuple[str, ...], _among(BACKGROUNDS)]


class LightSettings(Settings):
    """Uniform ranges. With ``beyond_deg`` either yaw or pitch (60 : 40) is at least so far off the front, on
    either side, and the other at most 20 degrees."""

    yaw_deg: LampAngles = (-45.0, 45.0)
    pitch_deg: LampAngles = (-45.0, 45.0)
    beyond_deg: float = Field(default=0.0, ge=0, lt=85)
    ambient: Share = (0.25, 0.7)
    diffuse: Share = (0.2, 0.8)

    def draw(self, uniform: ndarray, brightest: float = np.inf) -> ndarray:
        """Ambient, diffuse, pitch and yaw (radians) from five uniform numbers: one each, and which of the
        angles is beyond. Ambient is limited so that ambient and diffuse together stay below ``brightest``."""
        diffuse, (low, high) = drawn(self.diffuse, uniform[1]), self.ambient
        ambient = drawn((low, max(low, min(high, brightest - diffuse))), uniform[0])
        pitch = drawn(self.pitch_deg, uniform[2], self.beyond_deg)
        yaw = drawn(self.yaw_deg, uniform[3], self.beyond_deg)
        if self.beyond_deg > 0 and uniform[4] < _YAW_SHARE:
            pitch = _OTHER_DEG * (2.0 * uniform[2] - 1.0)
        elif self.beyond_deg > 0:
            yaw = _OTHER_DEG * (2.0 * uniform[3] - 1.0)
        return np.array([ambient, diffuse, *np.deg2rad([pitch, yaw])], np.float32)


class ViewSettings(Settings):
    """Ranges of the camera's angles. A spread (``*_sd_deg``) draws a normal about the middle of the range,
    clipped at its ends; without one (null) the range is uniform. With ``yaw_beyond_deg`` yaw is uniform on
    either side, from there to the range's ends. Shifts are scene units, right and down; one pixel of 64 is
    0.0028."""

    yaw_deg: Annotated[Range, _within(-90, 90)] = (-45.0, 45.0)
    yaw_sd_deg: float | None = Field(default=18.0, ge=0, le=90)
    yaw_beyond_deg: Annotated[float, _inside("yaw_deg")] = Field(default=0.0, ge=0, lt=90)
    pitch_deg: Annotated[Range, _within(-60, 60)] = (-20.0, 20.0)
    pitch_sd_deg: float | None = Field(default=8.0, ge=0, le=90)
    roll_deg: Angles = (-12.0, 12.0)
    roll_sd_deg: float | None = Field(default=4.0, ge=0, le=90)
    shift: Shift = (-0.008, 0.008)
    shift_sd: float | None = Field(default=0.0035, ge=0, le=0.1)


class CarViewSettings(Settings):
    """A turntable seen from above: uniform elevation above the ground and azimuth about the vertical axis.

    Azimuth 0 sees the front; above 0 the front moves to the left of the image. With ``azimuth_beyond_deg``
    azimuth is uniform on either side, from there to the range's ends. Rotation in the image plane and shifts
    are normal, clipped at their ranges' ends. A car never leaves the image by a shift."""

    elevation_deg: Annotated[Range, _within(0, 90)] = (25.0, 60.0)
    azimuth_deg: Angles = (-30.0, 30.0)
    azimuth_beyond_deg: Annotated[float, _inside("azimuth_deg")] = Field(default=0.0, ge=0, lt=180)
    inplane_deg: Angles = (-8.0, 8.0)
    inplane_sd_deg: float = Field(default=3.0, ge=0, le=90)
    shift: Shift = (-0.008, 0.008)
    shift_sd: float = Field(default=0.003, ge=0, le=0.1)


class EffectSettings(Settings):
    """What light does beyond one lamp on a matt surface; by default nothing. Ranges are uniform, and even in
    the logarithm for exponent and beta. Further lamps have 0.3 to 1 of the first one's strength."""

    gloss: Annotated[Range, _within(0, 0.5)] = (0.0, 0.0)  # strength of the highlight
    exponent: Annotated[Range, _within(1, 128)] = (4.0, 64.0)
    shadows: bool = False
    lamps: int = Field(default=1, ge=1, le=4)
    lamp_deg: float = Field(default=60.0, ge=0, le=85)  # pitch and yaw of further lamps lie in +- this
    haze: Annotated[Range, _within(0, 4)] = (0.0, 0.0)  # beta, 0 for none
    airlight: Annotated[Range, _within(0.25, 1)] = (0.6, 1.0)

    @property
    def any(self) -> bool:
        return self.shadows or self.lamps > 1 or self.gloss[1] > 0 or self.haze[1] > 0

    def draw(
        self, generator: np.random.Generator, ambient: np.float32, lamp: ndarray, turn: ndarray, size: int
    ) -> tuple[Lighting, dict[str, Any]]:
        """The light of one image, and labels of what it has beyond its first ``lamp`` (4,).

        ``turn`` takes directions from the canonical to the camera's frame; settings change no other draw.
        """
        share, lamps = generator.random(4), generator.random((3, 3))
        gloss = np.array([drawn(self.gloss, share[0]), _even_in_log(self.exponent, share[1])], np.float32)
        haze = np.array([_even_in_log(self.haze, share[2]), drawn(self.airlight, share[3])], np.float32)
        lamps = lamps[: self.lamps - 1]
        pitch, yaw = np.deg2rad(self.lamp_deg) * (2 * lamps[:, 1:].T - 1)
        rows = np.stack([np.tan(yaw), np.tan(pitch), np.ones_like(yaw)], axis=1)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        power = lamp[0] * (0.3 + 0.7 * lamps[:, :1])
        labels: dict[str, Any] = {}
        if self.gloss[1] > 0:
            labels |= {"gloss_strength": gloss[0], "gloss_exponent": gloss[1]}
        if self.haze[1] > 0:
            labels |= {"haze_beta": haze[0], "haze_airlight": haze[1]}
        angles = np.rad2deg(np.stack([pitch, yaw], axis=1)).astype(np.float32)
        for n, (force, own) in enumerate(zip(power[:, 0].astype(np.float32), angles, strict=True), 2):
            labels |= {f"lamp{n}": force, f"lamp{n}_pitch": own[0], f"lamp{n}_yaw": own[1]}
        every = np.vstack([lamp, np.hstack([power, rows @ turn.T])]).astype(np.float32)
        room = (len(every), TEXELS * size, TEXELS * size) if self.shadows else (0, 0, 0)
        empty = (np.zeros(shape, np.float32) for shape in ((len(every), 2, 3), 3, room))
        return Lighting(ambient, every, gloss, haze, *empty), labels


def _even_in_log(ends: Range, share: float) -> float:
    """The value at that share of a range's logarithms; of one that starts at 0, of the range itself."""
    return drawn(ends, share) if ends[0] <= 0 else float(ends[0] * (ends[1] / ends[0]) ** share)


def _named(settings: type[Kind], kind: str, table: str) -> Mapping[str, Kind]:
    return {name: settings.model_validate(row) for name, row in numbers_of(kind)[table].items()}


LIGHTS, CAR_LIGHTS = (_named(LightSettings, kind, "lights") for kind in ("faces", "cars"))
VIEWS, CAR_VIEWS = _named(ViewSettings, "faces", "views"), _named(CarViewSettings, "cars", "views")


class FaceSettings(Settings):
    """Every option of generated faces.

    With ``tracks`` (per identity) images come as sequences of ``frames``: light and background stay, head
    and expression move smoothly; otherwise an identity has ``pictures_per_identity`` images.
    """

    light: LightSettings = LightSettings()
    view: ViewSettings = ViewSettings()
    effects: EffectSettings = EffectSettings()
    pictures_per_identity: int = Field(default=8, ge=1)
    first_identity: int = Field(default=0, ge=0)  # other people from the same seed
    tracks: int = Field(default=0, ge=0)
    frames: int = Field(default=6, ge=1)
    expressions: Annotated[Shares, _among(EXPRESSIONS)] = dict.fromkeys(EXPRESSIONS, 1.0)
    strength: Annotated[Range, _within(0, 1.5)] = (0.4, 1.05)
    asymmetry: float = Field(default=0.12, ge=0, le=1)  # sd by which the two halves of an expression differ
    gaze_px: float = Field(default=0.6, ge=0, le=3)  # sd of the irises' shift
    age_years: Annotated[Range, _within(16, 100)] = (18.0, 80.0)
    skin_tone: Share = (0.0, 1.0)  # 0 fair .. 1 dark
    backgrounds: Backgrounds = BACKGROUNDS

    @property
    def per_identity(self) -> int:
        """Number of consecutive images that show one person."""
        return self.tracks * self.frames or self.pictures_per_identity


class CarSettings(Settings):
    """Every option of generated cars."""

    light: LightSettings = CAR_LIGHTS["usual"]  # in the canonical frame
    brightest: float = Field(default=1.3, ge=0.1, le=2)  # limit of ambient and diffuse together
    view: CarViewSettings = CarViewSettings()
    effects: EffectSettings = EffectSettings()
    classes: Annotated[Shares, _among(CLASSES)] = dict.fromkeys(CLASSES, 1.0)
    pictures_per_model: int = Field(default=4, ge=1)  # consecutive images that show one car
    first_model: int = Field(default=0, ge=0)  # other cars from the same seed
    size: float = Field(default=0.198, gt=0.01, le=0.3)  # diagonal of the bounding box; the image: 0.175
    backgrounds: Backgrounds = BACKGROUNDS


def named_settings(
    kind: type[Kind], light: str = "usual", view: str = "usual", overrides: Iterable[str] = (), **own: Any
) -> Kind:
    """Settings by the names of their lighting and viewpoints, with own values by keyword.

    Overrides such as ``light.yaw_deg=[-60,60]`` come last. A ValueError: an unknown name, or as
    ``with_changes`` raises it.
    """
    lights, views = (LIGHTS, VIEWS) if kind is FaceSettings else (CAR_LIGHTS, CAR_VIEWS)
    for option, name, known in (("light", light, lights), ("view", view, views)):
        require_known(option, name, tuple(known))
    chosen = kind.model_validate(own | {"light": lights[light], "view": views[view]})
    return with_changes(chosen, overrides)
