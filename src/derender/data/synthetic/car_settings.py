"""Which cars, views and lights generated pictures of cars show; defaults follow the rendered development set.

Angles are degrees because people write settings. A setting changes only what it names: the random numbers
behind each picture do not depend on it. ``CAR_LIGHTS`` and ``CAR_VIEWS`` name whole sets of them under the
names that the faces' have: "wide" is outside what "usual" ever shows."""

from collections.abc import Mapping

from pydantic import Field, model_validator

from derender.data.synthetic.car_traits import CLASSES
from derender.data.synthetic.settings import (
    BACKGROUNDS,
    LIGHTS,
    LightSettings,
    Range,
    Shares,
    check_beyond,
    check_names,
    check_range,
    check_shares,
)
from derender.settings import Settings


class CarViewSettings(Settings):
    """A turntable seen from above: uniform elevation above the ground and azimuth about the car's vertical
    axis.

    Azimuth 0 sees the front; above 0 the front moves to the left of the picture. With
    ``azimuth_beyond_deg`` azimuth is uniform on either side, from there to the range's ends. The picture's
    own turn is normal, clipped at its range's ends, as are the shifts; a car that a shift would move out of
    the picture is shifted less."""

    elevation_deg: Range = (25.0, 60.0)
    azimuth_deg: Range = (-30.0, 30.0)
    azimuth_beyond_deg: float = Field(default=0.0, ge=0, lt=180)
    inplane_deg: Range = (-8.0, 8.0)
    inplane_sd_deg: float = Field(default=3.0, ge=0, le=90)
    shift: Range = (-0.008, 0.008)  # scene units, right and down; one pixel of 64 is 0.0028
    shift_sd: float = Field(default=0.003, ge=0, le=0.1)

    @model_validator(mode="after")
    def _possible(self) -> "CarViewSettings":
        for name, low, high in (
            ("elevation_deg", 0.0, 90.0), ("azimuth_deg", -180.0, 180.0), ("inplane_deg", -180.0, 180.0),
            ("shift", -0.1, 0.1),
        ):  # fmt: skip
            check_range(f"view.{name}", getattr(self, name), low, high)
        check_beyond("view.azimuth_beyond_deg", self.azimuth_beyond_deg, self.azimuth_deg)
        return self


_USUAL_LIGHT = LightSettings(diffuse=(0.5, 1.0))
CAR_LIGHTS: Mapping[str, LightSettings] = {
    "usual": _USUAL_LIGHT,
    "wide": LIGHTS["wide"],
    "frontal": LightSettings(yaw_deg=(0, 0), pitch_deg=(0, 0), ambient=(0.4, 0.4), diffuse=(0.6, 0.6)),
}
CAR_VIEWS: Mapping[str, CarViewSettings] = {
    "usual": CarViewSettings(),
    "wide": CarViewSettings(azimuth_deg=(-75, 75), azimuth_beyond_deg=35),
    "frontal": CarViewSettings(elevation_deg=(42.5, 42.5), azimuth_deg=(0, 0), inplane_sd_deg=0, shift_sd=0),
}


class CarSettings(Settings):
    """Everything that may be asked of generated cars.

    Attributes:
        light: of each picture, in the canonical frame.
        brightest: ambient is limited so that ambient and diffuse together stay below.
        view: of each picture.
        classes: share of each class of cars among the models, by name.
        pictures_per_model: consecutive pictures that show one car, in other lights and views.
        first_model: other cars from the same seed.
        size: length of the bounding box's diagonal in scene units; the picture is 0.175 wide there.
        backgrounds: kinds of background, drawn with equal chance.
    """

    light: LightSettings = _USUAL_LIGHT
    brightest: float = Field(default=1.3, ge=0.1, le=2)
    view: CarViewSettings = CarViewSettings()
    classes: Shares = Field(default=dict.fromkeys(CLASSES, 1.0))
    pictures_per_model: int = Field(default=4, ge=1)
    first_model: int = Field(default=0, ge=0)
    size: float = Field(default=0.198, gt=0.01, le=0.3)
    backgrounds: tuple[str, ...] = BACKGROUNDS

    @model_validator(mode="after")
    def _possible(self) -> "CarSettings":
        check_shares("classes", self.classes, CLASSES)
        check_names("backgrounds", self.backgrounds, BACKGROUNDS)
        return self
