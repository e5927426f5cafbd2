"""What is drawn for each picture of a car: which car, light, view, background.

A picture's draw is a function of seed and index alone. The view is a turntable's: M = Rz(inplane)
Rx(elevation) Ry(azimuth) takes the upright car, front towards the viewer, to the camera. The canonical
frame is the car seen from straight ahead and 42.5 degrees above, so the camera's rotation is R = M
Rx(42.5)^-1, given by its Euler angles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from derender.data.synthetic.backgrounds import draw_background
from derender.data.synthetic.car_settings import CarSettings, CarViewSettings
from derender.data.synthetic.draws import clipped, either_side, light_angles, name_at, scaled
from derender.data.synthetic.settings import LightSettings

CANONICAL_ELEVATION_DEG = 42.5
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class CarDraw:
    """One picture's draw: angles in degrees, ``rotation`` canonical to camera, ``shift`` wished for."""

    model: int
    elevation_deg: float
    azimuth_deg: float
    inplane_deg: float
    rotation: Float64[ndarray, "3 3"]
    shift: Float64[ndarray, "2"]
    light: Float32[ndarray, "4"]
    background: Float32[ndarray, "s s 3"]


def draw_car_picture(seed: int, index: int, image_size: int, settings: CarSettings) -> CarDraw:
    """The draw of picture number ``index``."""
    generator = np.random.default_rng([seed, 3, index])
    normal = generator.standard_normal(3)
    uniform = generator.random(8)
    view = settings.view
    elevation, azimuth = scaled(view.elevation_deg, uniform[0]), _azimuth(view, uniform[1])
    inplane = clipped(view.inplane_sd_deg * normal[0], view.inplane_deg)
    kind = settings.backgrounds[int(uniform[7] * len(settings.backgrounds))]
    return CarDraw(
        model=settings.first_model + index // settings.pictures_per_model,
        elevation_deg=elevation,
        azimuth_deg=azimuth,
        inplane_deg=inplane,
        rotation=view_rotation(elevation, azimuth, inplane) @ about_x(CANONICAL_ELEVATION_DEG).T,
        shift=np.clip(view.shift_sd * normal[1:], *view.shift),
        light=_light(settings.light, settings.brightest, uniform[2:7]),
        background=draw_background(kind, generator, image_size),
    )


def class_of(seed: int, model: int, settings: CarSettings) -> str:
    """The class of a model. Shares are kept closely by any run of models: a golden-ratio sequence."""
    start = np.random.default_rng([seed, 4]).random()
    return name_at(settings.classes, (start + model * _GOLDEN) % 1.0)


def view_rotation(elevation_deg: float, azimuth_deg: float, inplane_deg: float) -> Float64[ndarray, "3 3"]:
    """M, from the upright car to the camera's axes."""
    a, b = np.deg2rad([azimuth_deg, inplane_deg])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    return about_z @ about_x(elevation_deg) @ about_y


def about_x(angle_deg: float) -> Float64[ndarray, "3 3"]:
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def euler_angles(rotation: Float64[ndarray, "3 3"]) -> Float64[ndarray, "3"]:
    """Angles about x, y, z (radians) of R = Rz Ry Rx."""
    return np.array(
        [
            np.arctan2(rotation[2, 1], rotation[2, 2]),
            np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0)),
            np.arctan2(rotation[1, 0], rotation[0, 0]),
        ]
    )


def _azimuth(view: CarViewSettings, share: float) -> float:
    if view.azimuth_beyond_deg > 0:
        return either_side(view.azimuth_deg, view.azimuth_beyond_deg, share)
    return scaled(view.azimuth_deg, share)


def _light(light: LightSettings, brightest: float, uniform: ndarray) -> Float32[ndarray, "4"]:
    diffuse = scaled(light.diffuse, uniform[1])
    low, high = light.ambient
    ambient = scaled((low, max(low, min(high, brightest - diffuse))), uniform[0])
    return np.array([ambient, diffuse, *light_angles(light, uniform[2:])], np.float32)
