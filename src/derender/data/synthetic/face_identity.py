"""The identity of a procedural face: shape coefficients, skin, hair, brows, eyes and lips.

Traits are correlated loosely as among people (dark skin with dark hair and eyes, heavy brow ridges with
wide jaws and beards, age with grey hair and folds), and every one stays variable on its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

_SKIN = np.array([
    (0.96, 0.80, 0.72), (0.92, 0.72, 0.61), (0.83, 0.62, 0.49),
    (0.70, 0.50, 0.37), (0.54, 0.37, 0.27), (0.40, 0.27, 0.20),
])  # fmt: skip
_LIPSTICK = np.array([(0.70, 0.20, 0.22), (0.60, 0.18, 0.30), (0.78, 0.40, 0.38)])
_HAIR = {
    "black": (0.09, 0.08, 0.08), "dark brown": (0.19, 0.13, 0.10), "brown": (0.33, 0.22, 0.14),
    "auburn": (0.46, 0.24, 0.13), "blond": (0.76, 0.57, 0.32), "fair": (0.87, 0.73, 0.47),
}  # fmt: skip
_GREY = np.array((0.70, 0.69, 0.67))
_IRIS = (  # dark brown, brown, hazel, green, blue, grey
    (0.15, 0.08, 0.05), (0.29, 0.17, 0.09), (0.38, 0.29, 0.15),
    (0.30, 0.38, 0.26), (0.29, 0.43, 0.58), (0.42, 0.47, 0.50),
)  # fmt: skip
_CLOTH = np.array(
    [(0.12, 0.13, 0.17), (0.85, 0.85, 0.83), (0.25, 0.30, 0.42), (0.45, 0.16, 0.16), (0.30, 0.36, 0.28)]
)
SKIN_FIELDS = 6  # how many noise fields of face_skin are mixed into the skin
_HEAVY = {  # modes that go with the heavy (1) rather than the delicate (0) end of the build
    "brow_ridge": 0.9, "jaw_width": 0.7, "jaw_corner": 0.6, "chin_width": 0.6, "nose_width": 0.3,
    "neck_width": 1.0, "brow_height": -0.6, "face_length": 0.4, "upper_lip": -0.4, "lower_lip": -0.3,
    "forehead_bulge": -0.4, "temple": 0.2, "cheekbones": -0.2,
}  # fmt: skip
_OLD = {
    "fold": 2.2, "under_eye": 1.8, "cheek_fullness": -0.6, "nose_length": 0.6, "philtrum": 0.5, "jowls": 2.4,
    "upper_lip": -0.9, "lower_lip": -0.4, "brow_height": -0.5,
}  # fmt: skip
_LINES = ("forehead_lines", "crows_feet")  # they come with age alone
_SPREAD = 0.75
_LESS = {  # modes that would look odd at the common spread
    "skull_width": 0.6, "jaw_width": 0.6, "jaw_corner": 0.5, "face_width": 0.7, "nose_turn": 0.7,
    "cheek_fullness": 0.7, "chin_width": 0.7, "cheekbones": 0.8,
}  # fmt: skip
_MODE_LIMIT = 2.0
YOUNG, OLD = 18.0, 80.0
BEARDS = ("none", "stubble", "moustache", "goatee", "short beard", "full beard")
# Rows of the line at those angles, relative to the forehead's hair line in front of the temple.
_SHORT = (0.0, -0.2, -1.2, -2.2, -0.5, 5.5, 15.0, 28.0, 24.0, 17.0, 21.0, 36.0, 46.0)
CURTAIN = (0.0, 0.4, 2.0, 6.0, 13.0, 27.0, 58.0, 95.0, 110.0, 120.0, 120.0, 120.0, 120.0)
_CROWN = (-30.0, -30.0, -30.0, -28.0, -24.0, -14.0, 4.0, 22.0, 20.0, 15.0, 19.0, 34.0, 44.0)


@dataclass(frozen=True)
class HairStyle:
    """Face pixels. ``top``, ``front``, ``side``, ``hang``: thickness on the crown, over the forehead's edge,
    over the ears, and below them; ``curl`` unevenness; ``cover`` opacity; ``fall`` how far a fringe falls;
    ``end`` the row at which hanging hair ends."""

    line: tuple[float, ...] = _SHORT
    top: float = 0.0
    front: float = 0.0
    side: float = 0.0
    hang: float = 0.0
    curl: float = 0.0
    cover: float = 1.0
    fall: float = 0.0
    end: float | None = None

    @property
    def covers_ears(self) -> bool:
        return self.side > 1.5


HAIR_STYLES: dict[str, HairStyle] = {
    "bald": HairStyle(cover=0.0),
    "receding": HairStyle(_CROWN, top=0.2, side=0.9, curl=0.1),
    "buzz": HairStyle(top=0.5, side=0.2, cover=0.7),
    "short": HairStyle(top=3.0, front=1.2, side=0.7, curl=0.12),
    "quiff": HairStyle(top=4.6, front=3.0, side=0.4, curl=0.15),
    "side part": HairStyle(top=3.4, front=1.8, side=0.9, fall=3.0),
    "fringe": HairStyle(top=3.2, front=1.4, side=0.9, fall=4.6),
    "curly": HairStyle(top=4.6, front=2.6, side=1.4, curl=0.6),
    "afro": HairStyle(top=6.5, front=4.2, side=5.0, curl=0.5),
    "tied": HairStyle(top=1.7, front=0.5, side=0.7),
    "bob": HairStyle(CURTAIN, top=3.2, front=1.2, side=2.6, hang=1.0, end=32.0),
    "bob with fringe": HairStyle(CURTAIN, top=3.2, front=1.2, side=2.6, hang=1.0, fall=5.5, end=31.0),
    "long": HairStyle(CURTAIN, top=2.8, front=1.2, side=1.9, hang=2.0, fall=0.6),
    "long with fringe": HairStyle(CURTAIN, top=2.8, front=1.2, side=1.9, hang=2.0, fall=5.5),
    "long wavy": HairStyle(CURTAIN, top=3.6, front=1.6, side=3.0, hang=4.5, curl=0.12, fall=1.0),
}


@dataclass(frozen=True)
class FaceIdentity:
    """Everything about one person that no image changes. Colours are stored RGB values, 0..1."""

    shape: dict[str, float]  # coefficient of every mode of face_shape
    scale: float  # size in the image, 1 = the mean face of the domain
    build: float  # 0 delicate .. 1 heavy
    age_years: float
    melanin: float  # 0 fair .. 1 dark
    skin: Float[ndarray, "3"]
    hair: Float[ndarray, "3"]
    hair_colour: str
    grey: float  # 0..1
    iris: Float[ndarray, "3"]
    lips: Float[ndarray, "3"]
    cloth: Float[ndarray, "3"]
    collar: float  # row at which clothes begin
    hair_style: str
    hair_line: float  # face pixels by which the hair line sits lower (+) or higher (-)
    hair_recession: float  # 0..1, at the temples
    hair_volume: float
    hair_parting: float  # -1 .. 1
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
    beard: str
    skin_noise: Float[ndarray, "fields"]

    @property
    def age(self) -> float:
        """0 at 18 years .. 1 at 80."""
        return age_of(self.age_years)

    def vector(self) -> dict[str, float | str]:
        """All traits as named numbers and words, for tables."""
        row: dict[str, float | str] = {f"shape_{name}": value for name, value in self.shape.items()}
        for name, value in vars(self).items():
            if name in ("shape", "skin_noise", "hair_wave"):
                continue
            if isinstance(value, ndarray):
                row.update({f"{name}_{channel}": float(v) for channel, v in zip("rgb", value, strict=True)})
            else:
                row[name] = value if isinstance(value, str) else float(value)
        return row


def draw_identity(
    generator: np.random.Generator,
    modes: tuple[str, ...],
    age_years: tuple[float, float] = (YOUNG, OLD),
    skin_tone: tuple[float, float] = (0.0, 1.0),
) -> FaceIdentity:
    """One person of an age and a skin tone within those ranges."""

    def uniform(low: float = 0.0, high: float = 1.0) -> float:
        return float(generator.uniform(low, high))

    def normal() -> float:
        return float(generator.standard_normal())

    build = float(np.clip(0.5 + 0.45 * np.sign(uniform(-1)) * uniform() ** 0.35, 0, 1))
    years = age_years[0] + (age_years[1] - age_years[0]) * uniform() ** 1.25
    age = age_of(years)
    melanin = skin_tone[0] + (skin_tone[1] - skin_tone[0]) * uniform()
    fair = (1.0 - melanin) ** 2
    spread = generator.standard_normal(len(modes))
    shape = {name: _mode(name, z, build, age) for name, z in zip(modes, spread, strict=True)}
    skin = _between(_SKIN, melanin) * (1.0 + generator.uniform(-0.035, 0.035, 3) + uniform(-0.05, 0.05))
    hair_colour, hair, grey = _hair_colour(generator, melanin, age)
    eyes = [0.25 + 2.5 * melanin, 0.6 + melanin, 0.5 * (1 - melanin) + 0.05]
    eyes += [0.4 * fair, 1.0 * fair**1.5, 0.3 * fair**1.5]
    iris = np.array(_IRIS[_pick(generator, eyes)]) * uniform(0.85, 1.2)
    lips = skin * np.array((0.90, 0.66, 0.66)) + np.array((0.02, 0.0, 0.01))
    strength = max(0.0, uniform(-0.35, 0.75)) * max(0.0, 1.0 - 1.6 * build)
    lips = (1.0 - strength) * lips + strength * (_between(_LIPSTICK, uniform()) * (0.55 + 0.45 * skin.mean()))
    hair_style = _hair_style(generator, build, age, melanin)
    beard = BEARDS[_pick(generator, [0.42, 0.28, 0.04, 0.07, 0.11, 0.08])]
    cloth = _CLOTH[_pick(generator, np.ones(len(_CLOTH)))] * generator.uniform(0.8, 1.15, 3)
    return FaceIdentity(
        shape=shape,
        scale=0.865 + 0.02 * float(np.clip(normal(), -2, 2)),
        build=build,
        age_years=years,
        melanin=melanin,
        skin=np.clip(skin, 0.0, 1.0),
        hair=hair,
        hair_colour=hair_colour,
        grey=grey,
        iris=iris,
        lips=np.clip(lips, 0.0, 1.0),
        cloth=np.clip(cloth, 0.0, 1.0),
        collar=uniform(34.0, 44.0),
        hair_style=hair_style,
        hair_line=uniform(-2.5, 1.8),
        hair_recession=uniform() * (0.2 + 0.8 * age) * build,
        hair_volume=uniform(0.75, 1.2),
        hair_parting=uniform(-1),
        hair_wave=generator.uniform(0, 1, 4),
        ear_size=float(np.clip(0.9 + 0.15 * normal() + 0.25 * (age - 0.4), 0.5, 1.3)),
        brow_thickness=uniform(0.65, 1.05) + 0.35 * build,
        brow_arch=uniform(0.2, 1.2) * (1.2 - 0.6 * build),
        brow_strength=uniform(0.6, 0.95) * (1.0 - 0.25 * age),
        eye_length=5.2 + 0.25 * float(np.clip(normal(), -2, 2)),
        eye_opening=uniform(0.92, 1.25) - 0.15 * age,
        eye_tilt=uniform(-0.04, 0.12) - 0.05 * age,
        lashes=uniform(0.5, 0.8) + 0.3 * (1 - build),
        lid_crease=uniform(0.3, 1.0),
        blush=uniform(0.2, 1.0),
        freckles=max(0.0, uniform(-1.6)) * (1.0 - melanin),
        beard=beard if build > 0.55 else "none",
        skin_noise=generator.standard_normal(SKIN_FIELDS),
    )


def age_of(years: float) -> float:
    """0 at 18 years .. 1 at 80, and a little beyond."""
    return float(np.clip((years - YOUNG) / (OLD - YOUNG), 0.0, 1.2))


def _mode(name: str, z: float, build: float, age: float) -> float:
    """The coefficient of a mode from a normal number."""
    if name in _LINES:
        value = max(0.0, 2.4 * (age - 0.35)) * (1.0 + 0.35 * np.clip(z, -2, 2))
    elif name == "jowls":
        value = max(0.0, _OLD[name] * (age - 0.45) + 0.3 * z)
    else:
        value = _SPREAD * _LESS.get(name, 1.0) * z + _HEAVY.get(name, 0.0) * (2.0 * build - 1.0)
        value += _OLD.get(name, 0.0) * (age - 0.35)
    return float(np.clip(value, -_MODE_LIMIT, _MODE_LIMIT))


def _between(stops: ndarray, position: float) -> ndarray:
    """Linear interpolation along a list of colours, position 0..1."""
    at = np.linspace(0.0, 1.0, len(stops))
    return np.array([np.interp(position, at, stops[:, k]) for k in range(3)])


def _pick(generator: np.random.Generator, weights: Sequence[float] | ndarray) -> int:
    edges = np.cumsum(np.asarray(weights) / np.sum(weights))
    return int(min(np.searchsorted(edges, generator.uniform()), len(weights) - 1))


def _hair_colour(
    generator: np.random.Generator, melanin: float, age: float
) -> tuple[str, Float[ndarray, "3"], float]:
    """Name, colour as seen, and share of grey."""
    fair = (1.0 - melanin) ** 2
    weights = [0.25 + 2.0 * melanin, 0.7 + melanin, 0.2 + 0.8 * fair, 0.5 * fair, 1.0 * fair, 0.4 * fair]
    name = list(_HAIR)[_pick(generator, weights)]
    colour = np.array(_HAIR[name]) * generator.uniform(0.85, 1.2)
    grey = float(np.clip(generator.uniform(-0.45, 0.35) + 1.9 * (age - 0.52), 0.0, 0.95))
    seen = np.clip((1.0 - grey) * colour + grey * _GREY, 0.0, 1.0)
    return ("grey" if grey > 0.5 else name), seen, grey


def _hair_style(generator: np.random.Generator, build: float, age: float, melanin: float) -> str:
    afro = max(0.0, melanin - 0.6)
    heavy = {
        "bald": 0.1 + 0.5 * age, "receding": max(0.0, 1.8 * (age - 0.35)), "buzz": 0.35, "short": 1.0,
        "quiff": max(0.0, 0.8 * (1.0 - age)), "side part": 0.7, "fringe": 0.12, "curly": 0.35,
        "afro": 0.5 * afro, "long": 0.06, "long wavy": 0.06,
    }  # fmt: skip
    delicate = {
        "bald": 0.015, "buzz": 0.03, "short": 0.15 + 0.5 * age, "side part": 0.15 + 0.3 * age, "fringe": 0.1,
        "curly": 0.3 + 0.4 * age, "afro": 0.9 * afro, "tied": 0.6, "bob": 0.6, "bob with fringe": 0.35,
        "long": 0.9 - 0.6 * age, "long with fringe": 0.4 - 0.3 * age, "long wavy": 0.7 - 0.4 * age,
    }  # fmt: skip
    weights = [build**2 * heavy.get(k, 0.0) + (1.0 - build) ** 2 * delicate.get(k, 0.0) for k in HAIR_STYLES]
    return list(HAIR_STYLES)[_pick(generator, weights)]
