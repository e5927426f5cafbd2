"""Write synthetic images in the layout of the rendered data sets, truth maps included.

``images/NNNNNN.jpg`` (JPEG quality 92, 4:4:4), ``params.csv`` (degrees), ``identities.csv``. With truth, as
PNG: ``depth/`` (16 bit, z = 0.8 + value/65535*0.4, 0 = background), ``normal/`` (round((n+1)/2*255)),
``albedo/``, ``mask/`` (255 = object). ``masks/`` has the number of the part, named line by line in
``classes.txt``. With effects also ``shading/``, ``visible/``, ``highlight/`` and ``transmission/`` (16 bit,
value/65535*2). Tracks lie at ``tracks/idNNNN/track_NNN/NNN.jpg`` without maps. The column ``expr_weights`` of
the morphable-model sets has no counterpart here.
"""

import csv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray
from PIL import Image

from derender.data.synthetic.synthetic_set import Progress, SyntheticSet, camera_rotation_and_light
from derender.storage.atomic import atomic_folder

DEPTH_LOW, DEPTH_SPAN, EFFECT_SPAN = 0.8, 0.4, 2.0
_MAPS = ("depth", "normal", "albedo", "mask", "masks")


def write(
    synthetic: SyntheticSet, folder: Path | str, truth: bool = True, progress: Progress | None = None
) -> Path:
    """Write images or tracks into a new folder, which appears when it is complete; gives that folder.

    Tracks lie in one folder per identity and track, without maps. ``progress(done, count)`` is called as
    images are written. A FileExistsError: the folder holds something.
    """
    require_empty(folder := Path(folder))
    files, maps = [f"images/{i:06d}.jpg" for i in range(len(synthetic))], (*_MAPS, *synthetic.effects)
    if "track" in synthetic.labels:
        numbers = zip(synthetic.identity, synthetic.labels["track"], synthetic.labels["frame"], strict=True)
        files = [f"tracks/id{who:04d}/track_{track:03d}/{frame:03d}.jpg" for who, track, frame in numbers]
        truth = False
    with atomic_folder(folder) as temporary:
        _fill(temporary, synthetic, files, maps if truth else (), progress)
    return folder


def require_empty(folder: Path) -> None:
    """Raise FileExistsError unless the folder is empty or missing."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists and is not empty: choose another folder")


def _fill(
    folder: Path, synthetic: SyntheticSet, files: list[str], maps: tuple[str, ...], progress: Progress | None
) -> None:
    for parent in {(folder / file).parent for file in files} | {folder / name for name in maps}:
        parent.mkdir(parents=True, exist_ok=True)

    def save(i: int) -> None:
        picture = Image.fromarray(synthetic.images[i].transpose(1, 2, 0))
        picture.save(folder / files[i], quality=92, subsampling=0)
        for name, pixels in _encoded(synthetic, i).items() if maps else ():
            Image.fromarray(pixels).save(folder / name / f"{i:06d}.png", compress_level=1)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for done, _ in enumerate(pool.map(save, range(len(files))), 1):
            if progress is not None:
                progress(done, len(files))
    if maps:
        (folder / "classes.txt").write_text("\n".join(synthetic.part_names) + "\n", encoding="utf-8")
    numbers, rows = np.unique(synthetic.identity, return_index=True)
    traits = {name: _texts(values[rows], 5) for name, values in synthetic.identity_traits.items()}
    _write_table(folder / "params.csv", {"file": files, **_parameters(synthetic)})
    _write_table(folder / "identities.csv", {"identity": _texts(numbers), **traits})


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
    light = np.einsum("nji,nj->in", rotation, seen)
    ambient, diffuse, *light_angles = synthetic.light.astype(float).T
    angles = np.rad2deg(
        [*light_angles, np.arctan2(seen[:, 1], seen[:, 2]), np.arctan2(seen[:, 0], seen[:, 2])]
    )
    pitch, yaw, roll, tx, ty, _ = synthetic.camera.astype(float).T
    columns = {
        "ambient": ambient, "diffuse": diffuse, "light_pitch": angles[0], "light_yaw": angles[1],
        "lx": light[0], "ly": light[1], "lz": light[2],
        "light_pitch_cam": angles[2], "light_yaw_cam": angles[3],
        "lx_cam": seen[:, 0], "ly_cam": seen[:, 1], "lz_cam": seen[:, 2],
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
