"""Write synthetic images in the layout of the rendered data sets, truth maps included.

``images/NNNNNN.jpg`` (JPEG quality 92, 4:4:4), ``params.csv`` (degrees), ``identities.csv``, and with truth
``depth/`` (16 bit, z = 0.8 + value/65535*0.4, 0 = background), ``normal/`` (round((n+1)/2*255)), ``albedo/``,
``mask/`` (255 = object) and ``masks/`` (number of the part, named line by line in ``classes.txt``) as PNG.
Tracks lie at ``tracks/idNNNN/track_NNN/NNN.jpg`` without maps. The column ``expr_weights`` of the
morphable-model sets has no counterpart here.
"""

import csv
import errno
import os
import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image

from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light
from derender.storage.atomic import atomic_folder

DEPTH_LOW, DEPTH_SPAN = 0.8, 0.4
_MAPS = ("depth", "normal", "albedo", "mask", "masks")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PREDICT_ABOVE, _COMPRESSION = 2, 1


def write(
    synthetic: SyntheticSet,
    folder: Path | str,
    truth: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the set into ``folder`` (made if missing, refused if it holds a set) and return that folder.

    ``progress(done, count)`` is called as images are written.
    """
    folder = _free(folder)
    for name in ("images", *(_MAPS if truth else ())):
        (folder / name).mkdir(parents=True, exist_ok=True)
    files = [f"images/{i:06d}.jpg" for i in range(len(synthetic))]

    def save(i: int) -> None:
        _save_image(synthetic, i, f"{folder}/{files[i]}")
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
        raise ValueError("these images are no tracks: generate them with the setting tracks above 0")
    folder = _free(folder)
    track, frame = synthetic.labels["track"], synthetic.labels["frame"]
    files = [
        f"tracks/id{synthetic.identity[i]:04d}/track_{track[i]:03d}/{frame[i]:03d}.jpg"
        for i in range(len(synthetic))
    ]
    for parent in {(folder / file).parent for file in files}:
        parent.mkdir(parents=True, exist_ok=True)
    _on_threads(lambda i: _save_image(synthetic, i, f"{folder}/{files[i]}"), len(files), progress)
    return _write_tables(synthetic, folder, files)


def require_empty(folder: Path) -> None:
    """Raise FileExistsError unless the folder is empty or missing."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists and is not empty: choose another folder")


def write_folder(
    synthetic: SyntheticSet,
    folder: Path,
    truth: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write images or tracks into a new folder, which appears when it is complete."""
    with atomic_folder(folder) as temporary:
        if "track" in synthetic.labels:
            write_tracks(synthetic, temporary, progress)
        else:
            write(synthetic, temporary, truth, progress)


def _on_threads(save: Callable[[int], None], count: int, progress: Callable[[int, int], None] | None) -> None:
    """Save images 0 to ``count`` on as many threads as computing uses."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for done, _ in enumerate(pool.map(save, range(count)), 1):
            if progress is not None:
                progress(done, count)


def _free(folder: Path | str) -> Path:
    folder = Path(folder)
    if (folder / "params.csv").exists():
        raise ValueError(f"{folder} already holds a set (params.csv): choose another folder or delete it")
    return folder


def _save_image(synthetic: SyntheticSet, i: int, path: str) -> None:
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
    numbers, rows = np.unique(synthetic.identity, return_index=True)
    traits = {name: _texts(values[rows], 5) for name, values in synthetic.identity_traits.items()}
    _write_table(folder / "params.csv", _parameters(synthetic, files))
    _write_table(folder / "identities.csv", {"identity": _texts(numbers), **traits})
    return folder


def encode_depth(depth: Float32[ndarray, "*shape"]) -> UInt16[ndarray, "*shape"]:
    """16-bit code of z in 0.8..1.2; 0 stays 0 and means background."""
    code = np.round((depth.astype(np.float64) - DEPTH_LOW) / DEPTH_SPAN * 65535)
    return np.where(depth > 0, np.clip(code, 1, 65535), 0).astype(np.uint16)


def encode_normal(normal: Float32[ndarray, "*shape 3"]) -> UInt8[ndarray, "*shape 3"]:
    """8-bit code of unit vectors."""
    return np.round((normal.astype(np.float64) + 1.0) / 2.0 * 255).astype(np.uint8)


def _parameters(synthetic: SyntheticSet, files: list[str]) -> dict[str, list[str]]:
    """The columns of params.csv; ``*_cam`` in the camera's frame, the others in the canonical one."""
    rotation, seen = camera_rotation_and_light(synthetic.camera, synthetic.light)
    light = np.stack([each.T @ direction for each, direction in zip(rotation, seen, strict=True)])
    ambient, diffuse, light_pitch, light_yaw = synthetic.light.astype(float).T
    pitch, yaw, roll, tx, ty, _ = synthetic.camera.astype(float).T
    columns = {
        "ambient": ambient, "diffuse": diffuse,
        "light_pitch": np.rad2deg(light_pitch), "light_yaw": np.rad2deg(light_yaw),
        "lx": light[:, 0], "ly": light[:, 1], "lz": light[:, 2],
        "light_pitch_cam": np.rad2deg(np.arctan2(seen[:, 1], seen[:, 2])),
        "light_yaw_cam": np.rad2deg(np.arctan2(seen[:, 0], seen[:, 2])),
        "lx_cam": seen[:, 0], "ly_cam": seen[:, 1], "lz_cam": seen[:, 2],
        "pitch": np.rad2deg(pitch), "yaw": np.rad2deg(yaw), "roll": np.rad2deg(roll), "tx": tx, "ty": ty,
    }  # fmt: skip
    labels = {name: _texts(values, 4) for name, values in synthetic.labels.items()}
    numbers = {name: _texts(values, 6) for name, values in columns.items()}
    return {"file": files, "identity": _texts(synthetic.identity), **labels, **numbers}


def _texts(values: ndarray, digits: int = 0) -> list[str]:
    return [f"{v:.{digits}f}" if isinstance(v, np.floating) else str(v) for v in values]


def _write_table(path: Path, columns: dict[str, list[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def encode_png(
    pixels: UInt8[ndarray, "h w"] | UInt16[ndarray, "h w"] | UInt8[ndarray, "h w 3"],
) -> bytes:
    """The PNG file of one image: grey of 8 or 16 bits, or RGB of 8 bits.

    Whole rows are predicted from the row above, with light compression. Pillow tries five predictions on
    every row and builds its chunks in Python; for maps of 64 pixels that is most of the time of saving.
    """
    height, width = pixels.shape[:2]
    rows = pixels.astype(pixels.dtype.newbyteorder(">"), copy=False).reshape(height, -1).view(np.uint8)
    lines = np.empty((height, 1 + rows.shape[1]), np.uint8)
    lines[:, 0] = _PREDICT_ABOVE
    lines[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=lines[1:, 1:])
    kind = 2 if pixels.ndim == 3 else 0  # RGB or grey
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, kind, 0, 0, 0)
    data = zlib.compress(lines.tobytes(), _COMPRESSION)
    return _PNG_SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
