"""The identity of a procedural face: shape coefficients, skin, hair, brows, eyes and lips.

Traits are correlated loosely as among people: dark skin with dark hair and eyes, heavy brow ridges with wide
jaws and beards, age with grey hair and folds. Each stays variable on its own.
"""

from typing import Any

import numpy as np
from numpy import ndarray

from derender.data.synthetic.settings import Range, drawn, numbers_of, pick
from derender.data.synthetic.synthetic_set import Row

Identity = dict[str, Any]
SKIN_FIELDS = 6  # how many noise fields of face_skin are mixed into the skin
YOUNG, OLD = 18.0, 80.0
_GREY = np.array((0.70, 0.69, 0.67))


def draw_identity(
    generator: np.random.Generator, modes: tuple[str, ...], age_years: Range, skin_tone: Range
) -> Identity:
    """One person of an age and a skin tone within those ranges: traits that no image changes, by name.
    Colours are stored RGB values, 0..1; lengths are face pixels."""
    numbers, uniform = numbers_of("faces"), generator.uniform
    build = float(np.clip(0.5 + 0.45 * np.sign(uniform(-1, 1)) * uniform() ** 0.35, 0, 1))
    years = drawn(age_years, uniform() ** 1.25)
    age = min(max((years - YOUNG) / (OLD - YOUNG), 0.0), 1.2)
    melanin = drawn(skin_tone, uniform())
    fair = (1.0 - melanin) ** 2
    z = generator.standard_normal(len(modes))
    shape = _shape(modes, z, build, age)
    skin = _between(numbers["skins"], melanin) * (1.0 + uniform(-0.035, 0.035, 3) + uniform(-0.05, 0.05))
    often = np.array([1.0, melanin, fair, fair**1.5])
    hairs, irises = (np.array([*numbers[name].values()]) for name in ("hairs", "irises"))
    number = pick(hairs[:, 3:] @ often, uniform())
    hair = hairs[number, :3] * uniform(0.85, 1.2)
    grey = min(max(uniform(-0.45, 0.35) + 1.9 * (age - 0.52), 0.0), 0.95)
    iris = irises[pick(irises[:, 3:] @ often, uniform()), :3] * uniform(0.85, 1.2)
    lips = skin * np.array((0.90, 0.66, 0.66)) + np.array((0.02, 0.0, 0.01))
    stick = max(0.0, uniform(-0.35, 0.75)) * max(0.0, 1.0 - 1.6 * build)
    painted = _between(numbers["lipsticks"], uniform()) * (0.55 + 0.45 * skin.mean())
    lips = (1.0 - stick) * lips + stick * painted
    weights = np.array([*numbers["hair_chances"].values()])
    common = np.maximum(weights[:, [0, 2]] + weights[:, [1, 3]] * age, 0.0)  # of heavy and delicate builds
    common += weights[:, 4:] * max(0.0, melanin - 0.6)
    style = pick(common @ [build**2, (1.0 - build) ** 2], uniform())
    beard = pick([*numbers["beards"].values()], uniform())
    cloth = np.array(numbers["cloths"][int(uniform() * len(numbers["cloths"]))]) * uniform(0.8, 1.15, 3)
    normal = generator.standard_normal
    return {
        "shape": dict(zip(modes, shape.tolist(), strict=True)),  # coefficient of every mode of face_shape
        "scale": 0.865 + 0.02 * min(max(normal(), -2), 2),  # size, 1 = the mean face of the domain
        "build": build,  # 0 delicate .. 1 heavy
        "age_years": years,
        "age": age,  # 0 at 18 years .. 1 at 80, and a little beyond
        "melanin": melanin,  # 0 fair .. 1 dark
        "skin": np.clip(skin, 0.0, 1.0),
        "hair": np.clip((1.0 - grey) * hair + grey * _GREY, 0.0, 1.0),
        "hair_colour": "grey" if grey > 0.5 else list(numbers["hairs"])[number],
        "grey": grey,  # 0..1
        "iris": iris,
        "lips": np.clip(lips, 0.0, 1.0),
        "cloth": np.clip(cloth, 0.0, 1.0),
        "collar": uniform(34.0, 44.0),  # row at which clothes begin
        "hair_style": list(numbers["hair_styles"])[style],
        "hair_line": uniform(-2.5, 1.8),  # by which the hair line sits lower (+) or higher (-)
        "hair_recession": uniform() * (0.2 + 0.8 * age) * build,  # 0..1, at the temples
        "hair_volume": uniform(0.75, 1.2),
        "hair_parting": uniform(-1, 1),
        "hair_wave": uniform(0, 1, 4),  # phases and sizes of the hair line's irregularity
        "ear_size": min(max(0.9 + 0.15 * normal() + 0.25 * (age - 0.4), 0.5), 1.3),
        "brow_thickness": uniform(0.65, 1.05) + 0.35 * build,
        "brow_arch": uniform(0.2, 1.2) * (1.2 - 0.6 * build),
        "brow_strength": uniform(0.6, 0.95) * (1.0 - 0.25 * age),
        "eye_length": 5.2 + 0.25 * min(max(normal(), -2), 2),
        "eye_opening": uniform(0.92, 1.25) - 0.15 * age,
        "eye_tilt": uniform(-0.04, 0.12) - 0.05 * age,
        "lashes": uniform(0.5, 0.8) + 0.3 * (1 - build),
        "lid_crease": uniform(0.3, 1.0),
        "blush": uniform(0.2, 1.0),
        "freckles": max(0.0, uniform(-1.6, 1)) * (1.0 - melanin),
        "beard": list(numbers["beards"])[beard] if build > 0.55 else "none",
        "skin_noise": generator.standard_normal(SKIN_FIELDS),
    }


def identity_columns(who: Identity) -> Row:
    """The traits as named numbers and words, for tables."""
    row: Row = {f"shape_{name}": value for name, value in who["shape"].items()}
    for name, value in who.items():
        if isinstance(value, ndarray) and len(value) == 3:
            row |= {f"{name}_{channel}": float(v) for channel, v in zip("rgb", value, strict=True)}
        elif name not in ("shape", "age", "skin_noise", "hair_wave"):
            row[name] = value if isinstance(value, str) else float(value)
    return row


def _shape(modes: tuple[str, ...], z: ndarray, build: float, age: float) -> ndarray:
    """Coefficients of modes from normal numbers."""
    tables = numbers_of("faces")
    spread, heavy, old = (
        np.array([tables[table].get(name, default) for name in modes])
        for table, default in (("spread", 1.0), ("heavy", 0.0), ("old", 0.0))
    )
    value = 0.75 * spread * z + heavy * (2.0 * build - 1.0) + old * (age - 0.35)
    for n, name in enumerate(modes):  # marks of age alone
        if name in ("forehead_lines", "crows_feet"):
            value[n] = max(0.0, 2.4 * (age - 0.35)) * (1.0 + 0.35 * np.clip(z[n], -2, 2))
        elif name == "jowls":
            value[n] = max(0.0, 2.4 * (age - 0.45) + 0.3 * z[n])
    return np.clip(value, -2.0, 2.0)


def _between(stops: list[list[float]], position: float) -> ndarray:
    """Linear interpolation along a list of colours, position 0..1."""
    at = np.linspace(0.0, 1.0, len(stops))
    return np.array([np.interp(position, at, channel) for channel in zip(*stops, strict=True)])
