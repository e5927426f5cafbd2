"""The set of images that generators return, drawn on threads, and written; and the backgrounds they share.

A generator gives the meshes, light and view of a run of consecutive images that show one object. Here they
are drawn into the rows of the result. So threads decide when an image is made and nothing else. A set is
written in the layout of the rendered data sets (docs/reference/files.md): JPEG of quality 92 (4:4:4), and
maps as PNG. Depth is z = 0.8 + value/65535*0.4, an effect value/65535*2, both of 16 bits. The column
``expr_weights`` of the morphable-model sets has no counterpart here.
"""

import csv
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8
from numpy import ndarray
from PIL import Image

from derender.data.stream import Progress
from derender.data.synthetic.lighting import EFFECTS
from derender.data.synthetic.mesh_image import ImageMaps, TriangleMesh, draw_mesh
from derender.data.synthetic.settings import EffectSettings
from derender.scene.camera import focal_px, rotation_matrix
from derender.scene.light import light_direction
from derender.storage.atomic import atomic_folder

FOV_DEG = 10.0
DEPTH_LOW, DEPTH_SPAN, EFFECT_SPAN = 0.8, 0.4, 2.0
Row = dict[str, int | float | np.float32 | str]
_LONGEST_RUN = 16
_NOISE_CELLS = 5


@dataclass(frozen=True)
class SyntheticSet:
    """N square images of size S with exact truth, one sample at each pixel's centre; maps are 0 on the
    background."""

    images: UInt8[ndarray, "n 3 s s"]  # shaded, over a background
    depth: Float32[ndarray, "n s s"]  # z in camera space
    normal: Float32[ndarray, "n s s 3"]  # inward unit normals in the camera frame
    albedo: UInt8[ndarray, "n 3 s s"]  # reflectance as seen by the camera
    mask: Bool[ndarray, "n s s"]  # where the object is
    parts: UInt8[ndarray, "n s s"]  # which part of the object is seen, a number into ``part_names``
    light: Float32[ndarray, "n 4"]  # ambient, diffuse, pitch, yaw (radians, canonical frame)
    camera: Float32[ndarray, "n 6"]  # rotation x, y, z (radians, about (0, 0, 1)), translation x, y, z
    identity: Int64[ndarray, "n"]  # number of the person or model
    labels: Mapping[str, Shaped[ndarray, "n"]]  # expression, age, ... of each image: text or numbers
    identity_traits: Mapping[str, Shaped[ndarray, "n"]]  # drawn for each image's identity
    part_names: tuple[str, ...]  # background first
    fov_deg: float = FOV_DEG  # field of view of every image
    effects: Mapping[str, Float32[ndarray, "n s s"]] = field(default_factory=dict)  # maps of ``EFFECTS``

    def __len__(self) -> int:
        return len(self.images)

    @property
    def expression(self) -> Shaped[ndarray, "n"]:
        """Name of each face's expression."""
        return self.labels["expression"]


class Shot(NamedTuple):
    """One image before it is drawn; ``light``, ``camera`` and the rest as in SyntheticSet."""

    mesh: TriangleMesh
    background: Float32[ndarray, "s s 3"]
    light: Float32[ndarray, "4"]
    camera: Float32[ndarray, "6"]
    identity: int
    labels: Row
    traits: Row


def camera_rotation_and_light(
    camera: Float32[ndarray, "n 6"], light: Float32[ndarray, "n 4"]
) -> tuple[Float64[ndarray, "n 3 3"], Float64[ndarray, "n 3"]]:
    """Rotation from canonical to camera frame, and the unit direction of light in the camera frame."""
    rotation = rotation_matrix(torch.from_numpy(camera[:, :3].astype(np.float64))).numpy()
    direction = light_direction(torch.from_numpy(light.astype(np.float64))).numpy()
    return rotation, np.einsum("nij,nj->ni", rotation, direction)


def make_set(
    shots: Callable[[list[int]], Iterable[Shot]], count: int, image_size: int, seed: int, first: int,
    per_object: int, part_names: tuple[str, ...], progress: Progress | None, effects: EffectSettings,
) -> SyntheticSet:  # fmt: skip
    """The set of ``count`` images from index ``first`` on; ``shots(indices)`` are some of one object.

    Raises:
        ValueError: a number that no set can have.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    if not 16 <= image_size <= 1024:
        raise ValueError(f"image_size must be 16..1024 pixels, got {image_size}")
    if seed < 0 or first < 0:
        raise ValueError(f"seed and first must be 0 or more, got seed {seed}, first {first}")
    plain, coloured = (count, image_size, image_size), (count, 3, image_size, image_size)
    maps = ImageMaps(
        *(np.zeros(coloured, np.uint8), np.zeros(plain, np.float32), np.zeros((*plain, 3), np.float32)),
        *(np.zeros(coloured, np.uint8), np.zeros(plain, bool), np.zeros(plain, np.uint8)),
        np.zeros((count, len(EFFECTS) if effects.any else 0, image_size, image_size), np.float32),
    )
    focal = np.float32(focal_px(image_size, FOV_DEG))

    def draw(indices: list[int]) -> list[tuple[Any, ...]]:
        rows = []
        for index, shot in zip(indices, shots(indices), strict=True):
            (rotation,), (direction,) = camera_rotation_and_light(shot.camera[None], shot.light[None])
            turn, shift, (ambient, diffuse) = rotation.astype(np.float32), shot.camera[3:], shot.light[:2]
            generator, lamp = np.random.default_rng([seed, 5, index]), np.array([diffuse, *direction])
            light, labels = effects.draw(generator, ambient, lamp, turn, image_size)
            out = ImageMaps(*(m[index - first] for m in maps))
            draw_mesh(shot.mesh, turn, shift, light, shot.background, focal, out)
            rows.append((*shot[2:5], shot.labels | labels, shot.traits))  # without meshes
        return rows

    runs = groupby(range(first, first + count), lambda i: (i // per_object, i % per_object // _LONGEST_RUN))
    made: list[tuple[Any, ...]] = []
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for rows in pool.map(draw, [list(indices) for _, indices in runs]):
            made += rows
            if progress is not None:
                progress(len(made), count)
    light, camera, identity, *tables = zip(*made, strict=True)
    labels, traits = ({name: np.array([row[name] for row in rows]) for name in rows[0]} for rows in tables)
    kept = {} if not effects.any else {name: maps.effects[:, n] for n, name in enumerate(EFFECTS)}
    arrays = (*maps[:-1], np.stack(light), np.stack(camera), np.array(identity))
    return SyntheticSet(*arrays, labels, traits, part_names, effects=kept)


def draw_background(kind: str, generator: np.random.Generator, size: int) -> Float32[ndarray, "s s 3"]:
    """A plain colour, a gradient between two, or smooth coloured noise; values 0..1. Strong colours are rare.

    Draws the same number of random values whatever the kind.
    """
    grey = generator.random((2, 1), dtype=np.float32)
    strength = np.float32(0.15 + 0.45 * generator.random() ** 2)
    start, end = grey + strength * (generator.random((2, 3), dtype=np.float32) - grey)
    angle = np.float32(generator.uniform(0.0, 2.0 * np.pi))
    knots = generator.random((_NOISE_CELLS, _NOISE_CELLS, 3), dtype=np.float32)
    if kind == "plain":
        return np.broadcast_to(start, (size, size, 3)).copy()
    if kind == "gradient":
        across = np.linspace(-1.0, 1.0, size, dtype=np.float32)
        at = 0.5 + 0.5 * (np.cos(angle) * across + np.sin(angle) * across[:, None]) / np.float32(np.sqrt(2.0))
        return start + (end - start) * at[..., None]
    coloured = np.float32(0.3) * strength * (knots - np.float32(0.5))
    knots = np.clip(start + (end - start) * knots[..., :1] + coloured, 0.0, 1.0)
    at = np.linspace(0.0, _NOISE_CELLS - 1.0, size, dtype=np.float32)[:, None]
    apart = np.abs(at - np.arange(_NOISE_CELLS, dtype=np.float32))
    near = np.maximum(np.float32(1.0) - apart, np.float32(0.0))
    share = near * near * (np.float32(3.0) - np.float32(2.0) * near)  # (size, cells)
    return share @ (share @ knots.reshape(_NOISE_CELLS, -1)).reshape(size, _NOISE_CELLS, 3)


def write(
    synthetic: SyntheticSet, folder: Path | str, truth: bool = True, progress: Progress | None = None
) -> Path:
    """Write images or tracks into a new folder, which appears when it is complete; gives that folder.

    Tracks lie in one folder per identity and track, without maps. ``progress(done, count)`` is called as
    images are written. A FileExistsError: the folder holds something.
    """
    require_empty(folder := Path(folder))
    files = [f"images/{i:06d}.jpg" for i in range(len(synthetic))]
    if "track" in synthetic.labels:
        shown = zip(synthetic.identity, synthetic.labels["track"], synthetic.labels["frame"], strict=True)
        files = [f"tracks/id{who:04d}/track_{track:03d}/{frame:03d}.jpg" for who, track, frame in shown]
        truth = False
    with atomic_folder(folder) as temporary:
        maps = map(Path, _encoded(synthetic, 0) if truth else ())
        for parent in {*maps, *(Path(file).parent for file in files)}:
            (temporary / parent).mkdir(parents=True, exist_ok=True)

        def save(i: int) -> None:
            picture = Image.fromarray(synthetic.images[i].transpose(1, 2, 0))
            picture.save(temporary / files[i], quality=92, subsampling=0)
            for name, pixels in _encoded(synthetic, i).items() if truth else ():
                Image.fromarray(pixels).save(temporary / name / f"{i:06d}.png", compress_level=1)

        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            for done, _ in enumerate(pool.map(save, range(len(files))), 1):
                if progress is not None:
                    progress(done, len(files))
        if truth:
            names = "\n".join(synthetic.part_names)
            (temporary / "classes.txt").write_text(names + "\n", encoding="utf-8")
        numbers, rows = np.unique(synthetic.identity, return_index=True)
        traits = {name: _texts(values[rows], 5) for name, values in synthetic.identity_traits.items()}
        _write_table(temporary / "params.csv", {"file": files, **_parameters(synthetic)})
        _write_table(temporary / "identities.csv", {"identity": _texts(numbers), **traits})
    return folder


def require_empty(folder: Path) -> None:
    """Raise FileExistsError unless the folder is empty or missing."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists and is not empty: choose another folder")


def _encoded(synthetic: SyntheticSet, i: int) -> dict[str, ndarray]:
    mask = synthetic.mask[i]
    depth, normal = synthetic.depth[i].astype(float), synthetic.normal[i].astype(float)
    code = np.clip(np.round((depth - DEPTH_LOW) / DEPTH_SPAN * 65535), 1, 65535)
    return {
        "depth": np.where(depth > 0, code, 0).astype(np.uint16),
        "normal": np.round((normal + 1.0) / 2.0 * 255).astype(np.uint8) * mask[..., None],
        "albedo": synthetic.albedo[i].transpose(1, 2, 0),
        "mask": mask.astype(np.uint8) * 255,
        "masks": synthetic.parts[i],
        **{
            name: np.round(maps[i].astype(float) / EFFECT_SPAN * 65535).clip(0, 65535).astype(np.uint16)
            for name, maps in synthetic.effects.items()
        },
    }


def _parameters(synthetic: SyntheticSet) -> dict[str, list[str]]:
    """The columns of params.csv; ``*_cam`` in the camera's frame, the others in the canonical one."""
    rotation, seen = camera_rotation_and_light(synthetic.camera, synthetic.light)
    (x, y, z), light = seen.T, np.einsum("nji,nj->in", rotation, seen)
    ambient, diffuse, *angles = synthetic.light.astype(float).T
    angles = np.rad2deg([*angles, np.arctan2(y, z), np.arctan2(x, z)])
    pitch, yaw, roll, tx, ty, _ = synthetic.camera.astype(float).T
    columns = {
        "ambient": ambient, "diffuse": diffuse, "light_pitch": angles[0], "light_yaw": angles[1],
        "lx": light[0], "ly": light[1], "lz": light[2],
        "light_pitch_cam": angles[2], "light_yaw_cam": angles[3], "lx_cam": x, "ly_cam": y, "lz_cam": z,
        "pitch": np.rad2deg(pitch), "yaw": np.rad2deg(yaw), "roll": np.rad2deg(roll), "tx": tx, "ty": ty,
    }  # fmt: skip
    labels = {name: _texts(values, 4) for name, values in synthetic.labels.items()}
    numbers = {name: _texts(values, 6) for name, values in columns.items()}
    return {"identity": _texts(synthetic.identity), **labels, **numbers}


def _texts(values: ndarray, digits: int = 0) -> list[str]:
    return [f"{v:.{digits}f}" if isinstance(v, np.floating) else str(v) for v in values]


def _write_table(path: Path, columns: dict[str, list[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
