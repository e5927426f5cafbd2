"""Who a procedural face is: shape coefficients, skin, hair, brows, eyes and lips, drawn once per identity.

Traits are correlated loosely as among people (dark skin with dark hair and eyes, heavy brow ridges with
wide jaws and beards, age with grey hair and folds), and every one stays variable on its own.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

_SKIN = np.array(
    [
        (0.95, 0.80, 0.72),
        (0.90, 0.71, 0.60),
        (0.80, 0.60, 0.47),
        (0.66, 0.46, 0.34),
        (0.49, 0.33, 0.24),
        (0.35, 0.23, 0.17),
    ]
)
_HAIR = {
    "black": (0.07, 0.06, 0.06), "dark brown": (0.16, 0.11, 0.08), "brown": (0.30, 0.20, 0.13),
    "auburn": (0.42, 0.21, 0.11), "blond": (0.68, 0.53, 0.33), "fair": (0.82, 0.71, 0.50),
}  # fmt: skip
_GREY = np.array((0.66, 0.65, 0.63))
_IRIS = {
    "dark brown": (0.13, 0.07, 0.04), "brown": (0.27, 0.15, 0.07), "hazel": (0.38, 0.28, 0.13),
    "green": (0.30, 0.38, 0.24), "blue": (0.30, 0.45, 0.62), "grey": (0.42, 0.47, 0.50),
}  # fmt: skip
HAIR_STYLES = ("bald", "buzz", "short", "fringe", "bob", "long")
SKIN_FIELDS = 6  # how many noise fields of face_skin are mixed into the skin
_HEAVY = {  # modes that go with the heavy (1) rather than the delicate (0) end of the build
    "brow_ridge": 0.9, "jaw_width": 0.7, "jaw_corner": 0.5, "chin_width": 0.6, "nose_width": 0.4,
    "neck_width": 0.9, "brow_height": -0.6, "face_length": 0.4, "upper_lip": -0.3, "lower_lip": -0.2,
    "forehead_bulge": -0.4, "temple": 0.2,
}  # fmt: skip
_OLD = {"fold": 1.8, "under_eye": 1.6, "cheek_fullness": -0.5, "nose_length": 0.5, "philtrum": 0.4}
_MODE_LIMIT = 2.2


@dataclass(frozen=True)
class FaceIdentity:
    """Everything about one person that no picture changes. Colours are stored RGB values, 0..1."""

    shape: dict[str, float]  # coefficient of every mode of face_shape
    scale: float  # size in the picture, 1 = the mean face of the domain
    build: float  # 0 delicate .. 1 heavy
    age: float  # 0 young .. 1 old
    melanin: float  # 0 fair .. 1 dark
    skin: Float[ndarray, "3"]
    hair: Float[ndarray, "3"]
    iris: Float[ndarray, "3"]
    lips: Float[ndarray, "3"]
    hair_style: str
    hair_line: float  # face pixels by which the hair line sits lower (+) or higher (-)
    hair_recession: float  # 0..1, at the temples
    hair_volume: float
    hair_parting: float  # 0 a closed fringe .. 1 parted in the middle
    hair_wave: Float[ndarray, "4"]  # phases and sizes of the hair line's irregularity
    ear_size: float
    brow_thickness: float
    brow_arch: float
    brow_strength: float
    eye_length: float
    eye_opening: float
    eye_tilt: float
    lashes: float
    lid_crease: float
    blush: float
    freckles: float
    stubble: float
    beard: float
    skin_noise: Float[ndarray, "fields"]

    def vector(self) -> dict[str, float]:
        """All traits as named numbers (the style by its index), for tables."""
        row: dict[str, float] = {f"shape_{name}": value for name, value in self.shape.items()}
        for name, value in vars(self).items():
            if name in ("shape", "skin_noise", "hair_wave"):
                continue
            if name == "hair_style":
                row[name] = float(HAIR_STYLES.index(value))
            elif isinstance(value, ndarray):
                row.update({f"{name}_{channel}": float(v) for channel, v in zip("rgb", value, strict=True)})
            else:
                row[name] = float(value)
        return row


def draw_identity(generator: np.random.Generator, modes: tuple[str, ...]) -> FaceIdentity:
    """One person."""
    build = float(
        np.clip(0.5 + 0.42 * np.sign(generator.uniform(-1, 1)) * generator.uniform(0, 1) ** 0.5, 0, 1)
    )
    age = float(generator.uniform(0, 1) ** 1.3)
    melanin = float(generator.uniform(0, 1))
    normal = generator.standard_normal(len(modes))
    lean = 2.0 * build - 1.0
    shape = {
        name: float(
            np.clip(
                0.95 * z + _HEAVY.get(name, 0.0) * lean + _OLD.get(name, 0.0) * (age - 0.4),
                -_MODE_LIMIT,
                _MODE_LIMIT,
            )
        )
        for name, z in zip(modes, normal, strict=True)
    }
    skin = _between(_SKIN, melanin) * (
        1.0 + generator.uniform(-0.045, 0.045, 3) + generator.uniform(-0.05, 0.05)
    )
    hair = _hair_colour(generator, melanin, age)
    iris_names = list(_IRIS)
    dark = np.array(
        [
            0.25 + 2.5 * melanin,
            0.6 + melanin,
            0.5,
            0.4 * (1 - melanin) ** 2,
            1.1 * (1 - melanin) ** 3,
            0.3 * (1 - melanin) ** 3,
        ]
    )
    iris = np.array(_IRIS[iris_names[_pick(generator, dark)]]) * generator.uniform(0.85, 1.2)
    made_up = generator.uniform() < 0.5 * (1.0 - build)
    lips = skin * np.array((0.93, 0.68, 0.68)) if not made_up else _lipstick(generator, skin)
    style = _hair_style(generator, build, age)
    stubble = float(generator.uniform(0.1, 1.0)) if build > 0.55 and generator.uniform() < 0.75 else 0.0
    beard = float(generator.uniform(0.5, 1.0)) if build > 0.55 and generator.uniform() < 0.28 else 0.0
    return FaceIdentity(
        shape=shape,
        scale=float(0.93 + 0.025 * np.clip(generator.standard_normal(), -2, 2)),
        build=build,
        age=age,
        melanin=melanin,
        skin=np.clip(skin, 0.0, 1.0),
        hair=hair,
        iris=iris,
        lips=np.clip(lips, 0.0, 1.0),
        hair_style=style,
        hair_line=float(generator.uniform(-3.0, 2.2)),
        hair_recession=float(generator.uniform(0, 1) * (0.25 + 0.75 * age) * build),
        hair_volume=float(generator.uniform(0.6, 1.4)),
        hair_parting=float(generator.uniform(-0.2, 1)),
        hair_wave=generator.uniform(0, 1, 4),
        ear_size=float(np.clip(0.9 + 0.2 * generator.standard_normal() + 0.25 * (age - 0.4), 0.4, 1.4)),
        brow_thickness=float(generator.uniform(0.65, 1.1) + 0.35 * build),
        brow_arch=float(generator.uniform(0.2, 1.2) * (1.2 - 0.6 * build)),
        brow_strength=float(generator.uniform(0.55, 0.95)),
        eye_length=float(5.0 + 0.3 * np.clip(generator.standard_normal(), -2, 2)),
        eye_opening=float(generator.uniform(0.82, 1.2) - 0.1 * age),
        eye_tilt=float(generator.uniform(-0.05, 0.13)),
        lashes=float(generator.uniform(0.5, 0.8) + 0.3 * (1 - build)),
        lid_crease=float(generator.uniform(0.2, 1.0)),
        blush=float(generator.uniform(0.2, 1.0)),
        freckles=float(max(0.0, generator.uniform(-1.2, 1.0)) * (1.0 - melanin)),
        stubble=stubble,
        beard=beard,
        skin_noise=generator.standard_normal(SKIN_FIELDS),
    )


def _between(stops: ndarray, position: float) -> ndarray:
    """Linear interpolation along a list of colours, position 0..1."""
    at = np.linspace(0.0, 1.0, len(stops))
    return np.array([np.interp(position, at, stops[:, k]) for k in range(3)])


def _pick(generator: np.random.Generator, weights: ndarray) -> int:
    edges = np.cumsum(weights / weights.sum())
    return int(min(np.searchsorted(edges, generator.uniform()), len(weights) - 1))


def _hair_colour(generator: np.random.Generator, melanin: float, age: float) -> Float[ndarray, "3"]:
    fair = (1.0 - melanin) ** 2
    weights = np.array(
        [0.25 + 2.0 * melanin, 0.7 + melanin, 0.2 + 0.8 * fair, 0.7 * fair, 1.1 * fair, 0.5 * fair]
    )
    colour = np.array(_HAIR[list(_HAIR)[_pick(generator, weights)]]) * generator.uniform(0.85, 1.2)
    grey = np.clip(generator.uniform(-0.4, 0.4) + 1.6 * (age - 0.55), 0.0, 0.9)
    return np.clip((1.0 - grey) * colour + grey * _GREY, 0.0, 1.0)


def _hair_style(generator: np.random.Generator, build: float, age: float) -> str:
    heavy = np.array([0.12 + 0.35 * age, 0.35, 1.0, 0.25, 0.05, 0.07])
    delicate = np.array([0.02, 0.05, 0.3, 0.22, 0.7, 1.0])
    return HAIR_STYLES[_pick(generator, build * heavy + (1.0 - build) * delicate)]


def _lipstick(generator: np.random.Generator, skin: ndarray) -> ndarray:
    tone = _between(
        np.array([(0.72, 0.20, 0.22), (0.62, 0.16, 0.30), (0.78, 0.40, 0.38)]), float(generator.uniform())
    )
    strength = generator.uniform(0.35, 0.85)
    return (1.0 - strength) * skin * np.array((0.93, 0.68, 0.68)) + strength * tone * (
        0.55 + 0.45 * skin.mean()
    )
