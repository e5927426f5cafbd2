"""A decomposition on disk: a folder per picture with its panel, one PNG per factor, and the numbers.

Each folder appears whole or not at all. ``scene.npz`` holds depth, albedo, normals, light and camera as
the renderer takes them; ``scene.json`` light and camera in words and degrees.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from derender.data import as_float
from derender.report.figures import Decomposition, decomposition
from derender.report.panel import strip
from derender.scene import Scene
from derender.scene.normals import normals_from_depth
from derender.storage.atomic import atomic_folder


def folder_names(pictures: Sequence[Path], out: Path) -> list[Path]:
    """A folder in ``out`` for each picture, named after it; equal names get a number."""
    taken: set[str] = set()
    folders = []
    for picture in pictures:
        name, number = picture.stem or "picture", 2
        while name.casefold() in taken:
            name, number = f"{picture.stem}-{number}", number + 1
        taken.add(name.casefold())
        folders.append(out / name)
    return folders


def write_decompositions(
    model: Any,
    pictures: Mapping[Path, tuple[Path, UInt8[np.ndarray, "3 s s"]]],
    *,
    batch_size: int = 64,
    refine: Callable[[Scene, Sequence[Path]], Scene] | None = None,
    progress: Callable[[int, int], object] | None = None,
    keep: Callable[[Decomposition], object] | None = None,
) -> list[dict[str, Any]]:
    """Take pictures apart, each into its folder (the keys; values: where it came from, and the picture).

    Args:
        model: with ``decompose``, ``render``, ``fov_deg``, ``device``.
        pictures: folder to where the picture came from, and the picture.
        batch_size: pictures at a time.
        refine: makes the scenes of these sources finer before they are drawn and written (``texture``).
        progress: called with (pictures done, pictures in all).
        keep: is given each batch as it was drawn (for a sheet).

    Gives one dictionary per picture: what its ``scene.json`` says.
    """
    records: list[dict[str, Any]] = []
    items = list(pictures.items())
    for start in range(0, len(items), batch_size):
        part = items[start : start + batch_size]
        images = as_float(np.stack([picture for _, (_, picture) in part])).to(model.device)
        with torch.no_grad():
            scene = model.decompose(images)
            if refine is not None:
                scene = refine(scene, [source for _, (source, _) in part])
        drawn = decomposition(images, scene, model.render, model.fov_deg)
        if keep is not None:
            keep(drawn)
        for index, (folder, (source, _)) in enumerate(part):
            record = {"picture": str(source), "folder": str(folder), **scene_numbers(drawn, index)}
            _write_folder(folder, drawn, index, scene[index], model.fov_deg, record)
            records.append(record)
            if progress is not None:
                progress(len(records), len(items))
    return records


def scene_numbers(drawn: Decomposition, index: int) -> dict[str, Any]:
    """Light and camera of one picture, angles in degrees."""
    ambient, diffuse, light_pitch, light_yaw = drawn.light[index].tolist()
    turn_x, turn_y, turn_z, x, y, z = drawn.camera[index].tolist()
    return {
        "light": {
            "ambient": ambient,
            "diffuse": diffuse,
            "pitch_deg": degrees(light_pitch),
            "yaw_deg": degrees(light_yaw),
        },
        "camera": {
            "rotation_deg": [degrees(turn_x), degrees(turn_y), degrees(turn_z)],
            "translation": [x, y, z],
        },
    }


def _write_folder(
    folder: Path, drawn: Decomposition, index: int, scene: Scene, fov_deg: float, record: Mapping[str, Any]
) -> None:
    with atomic_folder(folder) as temporary:
        drawn.panel(index).save(temporary / "panel.png")
        for name, images in drawn.columns.items():
            strip([images[index]]).save(temporary / f"{name.replace(' ', '_')}.png")
        (temporary / "scene.json").write_text(
            json.dumps(record, indent=1, ensure_ascii=False), encoding="utf-8"
        )
        parameters = scene.detach().parameters
        values: dict[str, Any] = {name: value[0].cpu().numpy() for name, value in parameters.items()}
        values["normal"] = normals_from_depth(scene.depth, fov_deg)[0].detach().cpu().numpy()
        np.savez_compressed(temporary / "scene.npz", **values)
