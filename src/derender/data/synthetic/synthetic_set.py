"""The set of images that generators return, made in batches on threads; and the backgrounds they share.

A batch is a run of consecutive images, whole objects where they fit, and writes into its rows of the result.
So the threads decide when an image is made and nothing else.
"""

import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8
from numpy import ndarray

from derender.scene.camera import rotation_matrix
from derender.scene.light import light_direction

FOV_DEG = 10.0
Row = dict[str, int | float | np.float32 | str]
Maps = dict[str, ndarray]  # a SyntheticSet's arrays by name
_BATCH = 16  # images of 64 pixels
_NOISE_CELLS = 5


@dataclass(frozen=True)
class SyntheticSet:
    """N square images of size S with exact truth, one sample at each pixel's centre.

    Attributes:
        images: shaded images over a background.
        depth: z in camera space, 0 on the background.
        normal: inward unit normals in the camera frame, 0 on the background.
        albedo: reflectance as seen by the camera, 0 on the background.
        mask: where the object is.
        parts: which part of the object is seen, a number into ``part_names``; 0 on the background.
        light: ambient, diffuse, pitch, yaw (radians, canonical frame).
        camera: rotation x, y, z (radians, about (0, 0, 1)), translation x, y, z.
        identity: number of the person or model.
        labels: what else is known of each image, by column name (expression, age, ...): text or numbers.
        identity_traits: the traits drawn for each image's identity, by name.
        part_names: names of the parts, background first.
        fov_deg: field of view of every image.
    """

    images: UInt8[ndarray, "n 3 s s"]
    depth: Float32[ndarray, "n s s"]
    normal: Float32[ndarray, "n s s 3"]
    albedo: UInt8[ndarray, "n 3 s s"]
    mask: Bool[ndarray, "n s s"]
    parts: UInt8[ndarray, "n s s"]
    light: Float32[ndarray, "n 4"]
    camera: Float32[ndarray, "n 6"]
    identity: Int64[ndarray, "n"]
    labels: Mapping[str, Shaped[ndarray, "n"]]
    identity_traits: Mapping[str, Shaped[ndarray, "n"]]
    part_names: tuple[str, ...]
    fov_deg: float = FOV_DEG

    def __len__(self) -> int:
        return len(self.images)

    @property
    def expression(self) -> Shaped[ndarray, "n"]:
        """Name of each face's expression."""
        return self.labels["expression"]

    @property
    def strength(self) -> Shaped[ndarray, "n"]:
        """How strongly each expression shows."""
        return self.labels["strength"]


def camera_rotation_and_light(
    camera: Float32[ndarray, "n 6"], light: Float32[ndarray, "n 4"]
) -> tuple[Float64[ndarray, "n 3 3"], Float64[ndarray, "n 3"]]:
    """Rotation from canonical to camera frame, and the unit direction of light in the camera frame."""
    rotation = rotation_matrix(torch.from_numpy(camera[:, :3].astype(np.float64))).numpy()
    direction = light_direction(torch.from_numpy(light.astype(np.float64))).numpy()
    return rotation, np.einsum("nij,nj->ni", rotation, direction)


def make_set(
    work: Callable[[range, Maps], list[tuple[Row, Row]]],
    prepare: Callable[[], object],
    count: int,
    image_size: int,
    seed: int,
    first: int,
    per_object: int,
    part_names: tuple[str, ...],
    progress: Callable[[int, int], None] | None,
) -> SyntheticSet:
    """The set of ``count`` images from index ``first`` on.

    ``work(indices, maps)`` fills the maps of these images and returns labels and traits of each;
    ``prepare()`` computes the values they share, before threads ask for them.

    Raises:
        ValueError: a number that no set can have.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    if not 16 <= image_size <= 1024:
        raise ValueError(f"image_size must be 16..1024 pixels, got {image_size}")
    if seed < 0 or first < 0:
        raise ValueError(f"seed and first must be 0 or more, got seed {seed}, first {first}")
    prepare()
    out = _empty(count, image_size)
    rows: list[tuple[Row, Row]] = []

    def batch(rows: slice) -> list[tuple[Row, Row]]:
        part = {name: value[rows] for name, value in out.items()}
        return work(range(first + rows.start, first + rows.stop), part)

    batches = _batches(first, count, per_object, max(1, _BATCH * 64 // image_size))
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for made in pool.map(batch, batches):
            rows += made
            if progress is not None:
                progress(len(rows), count)
    labels, traits = (
        {name: np.array([row[name] for row in each]) for name in each[0]} for each in zip(*rows, strict=True)
    )
    more: dict[str, Any] = {"labels": labels, "identity_traits": traits, "part_names": part_names}
    return SyntheticSet(**out, **more)


def _batches(first: int, count: int, per_object: int, most: int) -> list[slice]:
    """Consecutive rows to work on together: whole objects where they fit into ``most`` rows."""
    whole = max(1, most // per_object) * per_object
    starts = [0]
    while starts[-1] < count:
        in_block = (first + starts[-1]) % whole
        starts.append(min(starts[-1] + min(whole - in_block, most), count))
    return [slice(a, b) for a, b in itertools.pairwise(starts)]


def _empty(count: int, size: int) -> Maps:
    return {
        "images": np.zeros((count, 3, size, size), np.uint8),
        "depth": np.zeros((count, size, size), np.float32),
        "normal": np.zeros((count, size, size, 3), np.float32),
        "albedo": np.zeros((count, 3, size, size), np.uint8),
        "mask": np.zeros((count, size, size), bool),
        "parts": np.zeros((count, size, size), np.uint8),
        "light": np.zeros((count, 4), np.float32),
        "camera": np.zeros((count, 6), np.float32),
        "identity": np.zeros(count, np.int64),
    }


def draw_background(kind: str, generator: np.random.Generator, size: int) -> Float32[ndarray, "s s 3"]:
    """A plain colour, a gradient between two, or smooth coloured noise; values 0..1. Strong colours are rare.

    Draws the same number of random values whatever the kind.
    """
    grey = generator.random((2, 1), dtype=np.float32)
    strength = np.float32(0.15 + 0.45 * generator.random() ** 2)
    ends = grey + strength * (generator.random((2, 3), dtype=np.float32) - grey)
    angle = np.float32(generator.uniform(0.0, 2.0 * np.pi))
    knots = generator.random((_NOISE_CELLS, _NOISE_CELLS, 3), dtype=np.float32)
    if kind == "plain":
        return np.broadcast_to(ends[0], (size, size, 3)).copy()
    if kind == "gradient":
        across = np.linspace(-1.0, 1.0, size, dtype=np.float32)
        at = 0.5 + 0.5 * (np.cos(angle) * across + np.sin(angle) * across[:, None]) / np.float32(np.sqrt(2.0))
        return ends[0] + (ends[1] - ends[0]) * at[..., None]
    coloured = np.float32(0.3) * strength * (knots - np.float32(0.5))
    knots = np.clip(ends[0] + (ends[1] - ends[0]) * knots[..., :1] + coloured, 0.0, 1.0)
    across = _stretch(knots, size).transpose(1, 0, 2)
    return np.ascontiguousarray(_stretch(across, size).transpose(1, 0, 2))


def _stretch(knots: ndarray, size: int) -> ndarray:
    """Smooth interpolation of rows of knots to ``size`` rows."""
    low, part = _between(size)
    return knots[low] * (1.0 - part) + knots[low + 1] * part


@lru_cache(maxsize=4)
def _between(size: int) -> tuple[ndarray, ndarray]:
    """The knot before each row, and how far the row is on its way to the next one."""
    at = np.linspace(0.0, _NOISE_CELLS - 1.0, size, dtype=np.float32)
    low = np.minimum(at.astype(int), _NOISE_CELLS - 2)
    part = at - low
    return low, (part * part * (3.0 - 2.0 * part))[:, None, None].astype(np.float32)
