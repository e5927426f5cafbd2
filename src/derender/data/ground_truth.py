"""Reads the exact maps of a rendered set: depth, normals, albedo, mask, light and camera of every image.

Two layouts: synface64's, with a params.csv, described here; and images beside depth maps alone
(layouts/depth_pairs.py). Maps are in the camera frame of their image, as docs/conventions.md defines it.
Depth is stored as z = 0.8 + value / 65535 * 0.4, normals as (n + 1) / 2 * 255, albedo as 0..255; value 0 is
background.
"""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image

from derender.data.image import opened_image
from derender.data.layouts.depth_pairs import pairs_of, read_depth, subset_pairs
from derender.data.layouts.layout import Labels, base_name, read_csv
from derender.data.layouts.rendered import CAMERA, LIGHT, parameters_of, subset_folder, subsets_of
from derender.data.opening import open_source, parse_source
from derender.data.source import Source


@dataclass(frozen=True)
class GroundTruth:
    """N rendered images with everything that made them.

    Attributes:
        images: (N, 3, H, W) RGB.
        depth: (N, H, W) z in the camera frame; 0 where there is background.
        normal: (N, H, W, 3) inward unit normals in the camera frame, zero in the background; or None.
        albedo: (N, 3, H, W) in 0..1, zero in the background; or None.
        mask: (N, H, W) true on the object.
        light: (N, 4) ambient, diffuse, pitch, yaw (radians, canonical frame); or None.
        camera: (N, 6) rotation about x, y, z (radians), translation along x, y, z (z is 0); or None.
        files: the images' names, relative to the source.
        labels: the other columns (identity, expression, class, ...).
    """

    images: UInt8[np.ndarray, "n 3 h w"]
    depth: Float32[np.ndarray, "n h w"]
    normal: Float32[np.ndarray, "n h w 3"] | None
    albedo: Float32[np.ndarray, "n 3 h w"] | None
    mask: Bool[np.ndarray, "n h w"]
    light: Float32[np.ndarray, "n 4"] | None
    camera: Float32[np.ndarray, "n 6"] | None
    files: tuple[str, ...]
    labels: Labels

    def __len__(self) -> int:
        return len(self.files)


def read_ground_truth(
    source: str | Path, subset: str | None = None, *, limit: int | None = None, image_size: int | None = None
) -> GroundTruth:
    """Read the images of a rendered set that have a depth map.

    Args:
        source: a folder or zip in synface64's format or with folders ``image`` and ``depth``, or
            ``PATH::SUBSET``.
        subset: "test_gt" or "test" by default, or the only subset there is.
        limit: only the first so many.
        image_size: side to bring images and maps to, where the set is images beside depth maps alone; a
            set in synface64's format is read at the size it was rendered in.
    """
    path, named = parse_source(source)
    subset = subset or named
    with open_source(path) as opened:
        subsets = subsets_of(opened)
        if not subsets and pairs_of(opened):
            return _read_pairs(opened, subset, limit, image_size)
        default = next((name for name in ("test_gt", "test") if name in subsets), "train")
        folder = subset_folder(opened, subset, default)
        return _read_maps(opened, folder, limit)


def _read_maps(source: Source, folder: str, limit: int | None) -> GroundTruth:
    """The images of a subset in synface64's format, in the order of its params.csv."""
    table, known = f"{folder}params.csv", set(source.files)
    listed = [folder + row["file"] for row in read_csv(source, table, ("file",))]
    files = [file for file in listed if _map_name(folder, "depth", file) in known][:limit]
    if not files:
        raise ValueError(
            f"{source.path} has no depth maps for the images of {table} (expected {folder}depth/NAME.png)"
        )
    labels, _ = parameters_of(source, table, files)
    missing = [name for name in (*LIGHT, *CAMERA) if name not in labels]
    if missing:
        raise ValueError(f"{table} in {source.path} lacks the column for {missing[0]!r}")
    light = np.stack([labels.pop(name) for name in LIGHT], axis=1)
    camera = np.stack([labels.pop(name) for name in CAMERA], axis=1)

    def maps(kind: str, *modes: str) -> np.ndarray:
        return _stacked(source, [_map_name(folder, kind, file) for file in files], modes)

    def has(kind: str) -> bool:
        return any(file.startswith(f"{folder}{kind}/") for file in source.files)

    depth_code, mask = maps("depth", "I;16", "I"), maps("mask", "L") > 127
    images = _stacked(source, files, ("RGB",))
    if images.shape[:3] != mask.shape:
        raise ValueError(f"images in {folder}images are {images.shape[1:3]}, their maps {mask.shape[1:]}")
    return GroundTruth(
        images=_channels_first(images),
        depth=np.where(depth_code > 0, 0.8 + depth_code / 65535 * 0.4, 0).astype(np.float32),
        normal=_unit(maps("normal", "RGB"), mask) if has("normal") else None,
        albedo=_channels_first(maps("albedo", "RGB")).astype(np.float32) / 255 if has("albedo") else None,
        mask=mask,
        light=light,
        camera=np.pad(camera, ((0, 0), (0, 1))),
        files=tuple(files),
        labels=labels,
    )


def _read_pairs(source: Source, subset: str | None, limit: int | None, image_size: int | None) -> GroundTruth:
    """Images beside depth maps: neither normals nor albedo, light and camera are known."""
    pairs = dict(list(subset_pairs(source, subset).items())[:limit])
    read = [read_depth(source, file, image_size) for file in pairs.values()]
    images = []
    for (file, map_file), (depth, _) in zip(pairs.items(), read, strict=True):
        image = opened_image(source, file).convert("RGB")
        if image.width != image.height:
            raise ValueError(f"{file} in {source.path} is {image.size}: images with depth must be square")
        if image_size is not None:
            image = image.resize((image_size, image_size), Image.Resampling.BOX)
        if (image.height, image.width) != depth.shape or depth.shape != read[0][0].shape:
            raise ValueError(
                f"{file} in {source.path} is {image.size}, its map {map_file} {depth.shape[::-1]}: both "
                "must have one size, the same in the whole set; or give image_size"
            )
        images.append(np.asarray(image))
    return GroundTruth(
        images=_channels_first(np.stack(images)),
        depth=np.stack([depth for depth, _ in read]),
        normal=None,
        albedo=None,
        mask=np.stack([mask for _, mask in read]),
        light=None,
        camera=None,
        files=tuple(pairs),
        labels={},
    )


def _map_name(folder: str, kind: str, image: str) -> str:
    return f"{folder}{kind}/{PurePosixPath(base_name(image)).stem}.png"


def _unit(code: np.ndarray, mask: np.ndarray) -> np.ndarray:
    normal = code.astype(np.float32) / 255 * 2 - 1
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    return normal * mask[..., None]


def _channels_first(code: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(code.transpose(0, 3, 1, 2))


def _stacked(source: Source, files: list[str], modes: tuple[str, ...]) -> np.ndarray:
    """Images of one mode and one size, as they are stored."""
    known, arrays = set(source.files), []
    for file in files:
        if file not in known:
            raise ValueError(f"{source.path} has no {file}, which params.csv calls for")
        opened = opened_image(source, file)
        array = np.asarray(opened)
        if opened.mode not in modes or (arrays and array.shape != arrays[0].shape):
            raise ValueError(
                f"{file} in {source.path} is {opened.mode} {array.shape}; "
                f"expected {modes[0]}, and all of one size"
            )
        arrays.append(array)
    return np.stack(arrays)
