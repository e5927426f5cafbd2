"""Sets of images made here, good and bad for the method; no image shows anybody."""

from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter

from derender.data.image_set import ImageSet
from derender.data.synthetic import faces
from derender.data.synthetic.settings import FaceSettings, LightSettings, ViewSettings

SIDE = 64
FLAT = LightSettings(yaw_deg=(15.0, 15.0), pitch_deg=(10.0, 10.0), ambient=(0.5, 0.5), diffuse=(0.5, 0.5))
STILL = ViewSettings(yaw_deg=(0.0, 0.0), pitch_deg=(0.0, 0.0), roll_deg=(0.0, 0.0), shift=(0.0, 0.0))
SIDEWAYS = ViewSettings(yaw_deg=(30.0, 40.0), yaw_sd_deg=None)
COUNT = 108


@cache
def generated(kind: str, count: int = COUNT) -> np.ndarray:
    """Faces of our generator under the settings that ``kind`` names."""
    kinds = {"faces": {}, "one view": {"view": STILL}, "one light": {"light": FLAT}}
    kinds |= {"one view and light": {"view": STILL, "light": FLAT}, "from one side": {"view": SIDEWAYS}}
    settings = kinds[kind]
    each = 1 if kind == "faces" else 6  # images of a person, whose shape is made once
    made = faces.generate(count, SIDE, 11, FaceSettings(pictures_per_identity=each, **settings))
    made.images.setflags(write=False)
    return made.images


def landscapes(count: int, generator: np.random.Generator) -> np.ndarray:
    """Sky, hills and trees, each image with its own horizon, colours and clouds."""
    down, across = np.mgrid[:SIDE, :SIDE] / SIDE
    made = np.empty((count, 3, SIDE, SIDE))
    for picture in made:
        horizon = generator.uniform(0.3, 0.7)
        sky, haze = generator.uniform(80, 255, (2, 3)), generator.uniform(0, 60)
        ground = generator.uniform(20, 130, 3)
        share = np.clip(down / horizon, 0, 1)
        picture[:] = sky[0][:, None, None] * (1 - share) + (sky[1][:, None, None] + haze) * share
        ridge = horizon - 0.1 * np.sin(across[0] * generator.uniform(3, 12) + generator.uniform(0, 6))
        texture = 1 + 0.5 * gaussian_filter(generator.standard_normal((SIDE, SIDE)), 1)
        picture[:] = np.where(down > ridge, ground[:, None, None] * texture, picture)
        for _ in range(generator.integers(1, 7)):
            x, y = generator.uniform(-0.2, 1.2), generator.uniform(horizon, 1)
            size = generator.uniform(0.03, 0.12)
            tree = ((across - x) / size) ** 2 + ((down - y) / (1.6 * size)) ** 2 < 1
            picture[:] = np.where(tree, generator.uniform(10, 90, 3)[:, None, None], picture)
    return np.clip(made, 0, 255).astype(np.uint8)


def noise(count: int, generator: np.random.Generator) -> np.ndarray:
    return generator.integers(0, 256, (count, 3, SIDE, SIDE), dtype=np.uint8)


def moved(images: np.ndarray, generator: np.random.Generator, reach: int = 19) -> np.ndarray:
    """Each image shifted by chance, its edges continued."""
    wide = np.pad(images, ((0, 0), (0, 0), (reach, reach), (reach, reach)), mode="edge")
    corners = generator.integers(0, 2 * reach + 1, (len(images), 2))
    return np.stack([one[:, y : y + SIDE, x : x + SIDE] for one, (y, x) in zip(wide, corners, strict=True)])


def copies(count: int, generator: np.random.Generator) -> np.ndarray:
    """One face, again and again: shifted by up to a pixel, brightened, with a little noise."""
    shifted = moved(np.repeat(generated("faces")[:1], count, axis=0), generator, 1).astype(np.float64)
    gain = generator.uniform(0.92, 1.08, (count, 1, 1, 1))
    return np.clip(shifted * gain + generator.normal(0, 2, shifted.shape), 0, 255).astype(np.uint8)


def as_set(images: np.ndarray, **more) -> ImageSet:
    names = tuple(f"{number:05}.png" for number in range(len(images)))
    return ImageSet(np.ascontiguousarray(images), names, source="made", **more)
