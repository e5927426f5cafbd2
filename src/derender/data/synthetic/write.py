"""Write synthetic pictures in the layout of the rendered data sets, truth maps included.

``images/NNNNNN.jpg`` (JPEG quality 92, 4:4:4), ``params.csv`` (degrees), ``identities.csv``, and with truth
``depth/`` (16 bit, z = 0.8 + value/65535*0.4, 0 = background), ``normal/`` (round((n+1)/2*255)), ``albedo/``,
``mask/`` (255 = object) and ``masks/`` (number of the part, named line by line in ``classes.txt``) as PNG.
Tracks lie at ``tracks/idNNNN/track_NNN/NNN.jpg`` without maps. The column ``expr_weights`` of the
morphable-model sets has no counterpart here.
"""

import csv
import errno
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8, UInt16
from numpy import ndarray
from PIL import Image

from derender.data.synthetic.png import encode_png
from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light

DEPTH_LOW, DEPTH_SPAN = 0.8, 0.4
_MAPS = ("depth", "normal", "albedo", "mask", "masks")


def write(
    synthetic: SyntheticSet,
    folder: Path | str,
    truth: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the set into ``folder`` (made if missing, refused if it holds a set) and return that folder.

    ``progress(done, count)`` is called as pictures are written.
    """
    folder = _free(folder)
    for name in ("images", *(_MAPS if truth else ())):
        (folder / name).mkdir(parents=True, exist_ok=True)
    files = [f"images/{i:06d}.jpg" for i in range(len(synthetic))]

    def save(i: int) -> None:
        _save_picture(synthetic, i, f"{folder}/{files[i]}")
        if truth:
            for name, pixels in _encoded(synthetic, i).items():
                _save_new(f"{folder}/{name}/{i:06d}.png", encode_png(np.ascontiguousarray(pixels)))

    _on_threads(save, len(files), progress)
    if truth:
        (folder / "classes.txt").write_text("\n".join(synthetic.part_names) + "\n", encoding="utf-8")
    return _write_tables(synthetic, folder, files)


def write_tracks(
    synthetic: SyntheticSet, folder: Path | str, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write a set of tracks into ``folder``, one folder per identity and track; no maps are kept."""
    if "track" not in synthetic.labels:
        raise ValueError("these pictures are no tracks: generate them with the setting tracks above 0")
    folder = _free(folder)
    track, frame = synthetic.labels["track"], synthetic.labels["frame"]
    files = [
        f"tracks/id{synthetic.identity[i]:04d}/track_{track[i]:03d}/{frame[i]:03d}.jpg"
        for i in range(len(synthetic))
    ]
    for parent in {(folder / file).parent for file in files}:
        parent.mkdir(parents=True, exist_ok=True)
    _on_threads(lambda i: _save_picture(synthetic, i, f"{folder}/{files[i]}"), len(files), progress)
    return _write_tables(synthetic, folder, files)


def _on_threads(save: Callable[[int], None], count: int, progress: Callable[[int, int], None] | None) -> None:
    """Save pictures 0 to ``count`` on as many threads as computing uses."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for done, _ in enumerate(pool.map(save, range(count)), 1):
            if progress is not None:
                progress(done, count)


def _free(folder: Path | str) -> Path:
    folder = Path(folder)
    if (folder / "params.csv").exists():
        raise ValueError(f"{folder} already holds a set (params.csv): choose another folder or delete it")
    return folder


def _save_picture(synthetic: SyntheticSet, i: int, path: str) -> None:
    encoded = BytesIO()
    Image.fromarray(synthetic.images[i].transpose(1, 2, 0)).save(encoded, "JPEG", quality=92, subsampling=0)
    _save_new(path, encoded.getvalue())


def _save_new(path: str, content: bytes) -> None:
    """Write a file that is not there yet; for small files several times faster than opening it to replace it.

    Raises:
        FileExistsError: it is there.
    """
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o644)
    try:
        if os.write(file, content) != len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
    finally:
        os.close(file)


def _encoded(synthetic: SyntheticSet, i: int) -> dict[str, ndarray]:
    mask = synthetic.mask[i]
    return {
        "depth": encode_depth(synthetic.depth[i]),
        "normal": encode_normal(synthetic.normal[i]) * mask[..., None],
        "albedo": synthetic.albedo[i].transpose(1, 2, 0),
        "mask": mask.astype(np.uint8) * 255,
        "masks": synthetic.parts[i],
    }


def _write_tables(synthetic: SyntheticSet, folder: Path, files: list[str]) -> Path:
    rotation, seen = camera_rotation_and_light(synthetic.camera, synthetic.light)
    rows = [_parameters(synthetic, i, file, rotation[i], seen[i]) for i, file in enumerate(files)]
    _write_table(folder / "params.csv", rows)
    _write_table(folder / "identities.csv", _identities(synthetic))
    return folder


def encode_depth(depth: Float32[ndarray, "*shape"]) -> UInt16[ndarray, "*shape"]:
    """16-bit code of z in 0.8..1.2; 0 stays 0 and means background."""
    code = np.round((depth.astype(np.float64) - DEPTH_LOW) / DEPTH_SPAN * 65535)
    return np.where(depth > 0, np.clip(code, 1, 65535), 0).astype(np.uint16)


def encode_normal(normal: Float32[ndarray, "*shape 3"]) -> UInt8[ndarray, "*shape 3"]:
    """8-bit code of unit vectors."""
    return np.round((normal.astype(np.float64) + 1.0) / 2.0 * 255).astype(np.uint8)


def _parameters(
    synthetic: SyntheticSet,
    i: int,
    file: str,
    rotation: Float64[ndarray, "3 3"],
    seen: Float64[ndarray, "3"],
) -> dict[str, str]:
    """A row of params.csv; ``rotation`` goes to the camera's frame, where light comes from ``seen``."""
    ambient, diffuse, light_pitch, light_yaw = synthetic.light[i].astype(float)
    pitch, yaw, roll, tx, ty, _ = synthetic.camera[i].astype(float)
    light = rotation.T @ seen
    degrees = {
        "light_pitch": light_pitch, "light_yaw": light_yaw,
        "lx": light[0], "ly": light[1], "lz": light[2],
        "light_pitch_cam": np.arctan2(seen[1], seen[2]), "light_yaw_cam": np.arctan2(seen[0], seen[2]),
        "lx_cam": seen[0], "ly_cam": seen[1], "lz_cam": seen[2],
        "pitch": pitch, "yaw": yaw, "roll": roll, "tx": tx, "ty": ty,
    }  # fmt: skip
    angles = {"light_pitch", "light_yaw", "light_pitch_cam", "light_yaw_cam", "pitch", "yaw", "roll"}
    return {
        "file": file,
        "identity": str(int(synthetic.identity[i])),
        **{name: _text(values[i], 4) for name, values in synthetic.labels.items()},
        "ambient": f"{ambient:.6f}",
        "diffuse": f"{diffuse:.6f}",
        **{name: f"{np.rad2deg(value) if name in angles else value:.6f}" for name, value in degrees.items()},
    }


def _identities(synthetic: SyntheticSet) -> list[dict[str, str]]:
    numbers, rows = np.unique(synthetic.identity, return_index=True)
    traits = synthetic.identity_traits
    return [
        {"identity": str(int(n)), **{name: _text(values[i], 5) for name, values in traits.items()}}
        for n, i in zip(numbers, rows, strict=True)
    ]


def _text(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, (float, np.floating)) else str(value)


def _write_table(path: Path, rows: list[dict[str, str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
