"""Reads the exact maps of a rendered set: depth, normals, albedo, mask, light and camera of every picture.

Two layouts: synface64's, with a params.csv, described here; and pictures beside depth maps alone
(data/paired.py). Maps are in the camera frame of their picture, as docs/conventions.md defines it. Depth is
stored as z = 0.8 + value / 65535 * 0.4, normals as (n + 1) / 2 * 255, albedo as 0..255; value 0 is
background.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image

from derender.data.decode import DECODER_ERRORS
from derender.data.inventory import parse_source
from derender.data.layout import Labels, read_csv
from derender.data.paired import pairs_of, read_depth, subset_pairs
from derender.data.rendered import CAMERA, LIGHT, parameters_of, subset_folder, subsets_of
from derender.data.source import Source, open_source


@dataclass(frozen=True)
class GroundTruth:
    """N rendered pictures with everything that made them.

    Attributes:
        images: (N, 3, H, W) RGB.
        depth: (N, H, W) z in the camera frame; 0 where there is background.
        normal: (N, H, W, 3) inward unit normals in the camera frame, zero in the background; or None.
        albedo: (N, 3, H, W) in 0..1, zero in the background; or None.
        mask: (N, H, W) true on the object.
        light: (N, 4) ambient, diffuse, pitch, yaw (radians, canonical frame); or None.
        camera: (N, 6) rotation about x, y, z (radians), translation along x, y, z (z is 0); or None.
        files: the pictures' names, relative to the source.
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
    """Read the pictures of a rendered set that have a depth map.

    Args:
        source: a folder or zip in synface64's format or with folders ``image`` and ``depth``, or
            ``PATH::SUBSET``.
        subset: "test_gt" or "test" by default, or the only subset there is.
        limit: only the first so many.
        image_size: side to bring pictures and maps to, where the set is pictures beside depth maps alone; a
            set in synface64's format is read at the size it was rendered in.
    """
    path, named = parse_source(source)
    with open_source(path) as opened:
        if not subsets_of(opened) and pairs_of(opened):
            return _read_pairs(opened, subset or named, limit, image_size)
        subset = (
            subset
            or named
            or next((name for name in ("test_gt", "test") if name in subsets_of(opened)), None)
        )
        folder = subset_folder(opened, subset)
        table = f"{folder}params.csv"
        known = set(opened.files)
        rows = [
            row
            for row in read_csv(opened, table, ("file",))
            if _map_name(folder, "depth", row["file"]) in known
        ]
        rows = rows[:limit]
        if not rows:
            raise ValueError(
                f"{path} has no depth maps for the pictures of {table} (expected {folder}depth/NAME.png)"
            )
        names = [row["file"] for row in rows]
        labels = parameters_of(rows, f"{table} in {path}")
        missing = [name for name in (*LIGHT, *CAMERA) if name not in labels]
        if missing:
            raise ValueError(f"{table} in {path} lacks the column for {missing[0]!r}")
        read = _Reader(opened, folder, names)
        depth_code = read.maps("depth", ("I;16", "I"))
        mask = read.maps("mask", ("L",)) > 127
        return GroundTruth(
            images=read.pictures(mask.shape[1:]),
            depth=np.where(depth_code > 0, 0.8 + depth_code / 65535 * 0.4, 0).astype(np.float32),
            normal=read.optional("normal", lambda: _unit(read.maps("normal", ("RGB",)), mask)),
            albedo=read.optional("albedo", lambda: _channels_first(read.maps("albedo", ("RGB",)))),
            mask=mask,
            light=np.stack([labels.pop(name) for name in LIGHT], axis=1),
            camera=np.stack(
                [*(labels.pop(name) for name in CAMERA), np.zeros(len(rows), np.float32)], axis=1
            ),
            files=tuple(folder + name for name in names),
            labels=labels,
        )


def _read_pairs(source: Source, subset: str | None, limit: int | None, image_size: int | None) -> GroundTruth:
    """Pictures beside depth maps: neither normals nor albedo, light and camera are known."""
    pairs = dict(list(subset_pairs(source, subset).items())[:limit])
    read = [read_depth(source, file, image_size) for file in pairs.values()]
    pictures = []
    for (file, map_file), (depth, _) in zip(pairs.items(), read, strict=True):
        picture = _picture(source, file)
        if picture.width != picture.height:
            raise ValueError(f"{file} in {source.path} is {picture.size}: pictures with depth must be square")
        if image_size is not None:
            picture = picture.resize((image_size, image_size), Image.Resampling.BOX)
        if (picture.height, picture.width) != depth.shape or depth.shape != read[0][0].shape:
            raise ValueError(
                f"{file} in {source.path} is {picture.size}, its map {map_file} {depth.shape[::-1]}: both "
                "must have one size, the same in the whole set; or give image_size"
            )
        pictures.append(np.asarray(picture).transpose(2, 0, 1))
    return GroundTruth(
        images=np.ascontiguousarray(pictures),
        depth=np.stack([depth for depth, _ in read]),
        normal=None,
        albedo=None,
        mask=np.stack([mask for _, mask in read]),
        light=None,
        camera=None,
        files=tuple(pairs),
        labels={},
    )


def _picture(source: Source, file: str) -> Image.Image:
    try:
        with Image.open(io.BytesIO(source.read(file))) as picture:
            return picture.convert("RGB")
    except DECODER_ERRORS as problem:
        raise ValueError(f"{file} in {source.path} cannot be read: {problem}") from problem


def _map_name(folder: str, kind: str, picture: str) -> str:
    return f"{folder}{kind}/{PurePosixPath(picture).stem}.png"


def _unit(code: np.ndarray, mask: np.ndarray) -> np.ndarray:
    normal = code.astype(np.float32) / 255 * 2 - 1
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    return normal * mask[..., None]


def _channels_first(code: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(code.transpose(0, 3, 1, 2)).astype(np.float32) / 255


@dataclass(frozen=True)
class _Reader:
    """Reads the pictures and maps of some rows of one subset."""

    source: Source
    folder: str
    names: list[str]

    def optional(self, kind: str, read: Callable[[], np.ndarray]) -> np.ndarray | None:
        prefix = f"{self.folder}{kind}/"
        return read() if any(file.startswith(prefix) for file in self.source.files) else None

    def maps(self, kind: str, modes: tuple[str, ...]) -> np.ndarray:
        return self._stack([_map_name(self.folder, kind, name) for name in self.names], modes)

    def pictures(self, shape: tuple[int, ...]) -> np.ndarray:
        images = self._stack([self.folder + name for name in self.names], ("RGB",))
        if images.shape[1:3] != shape:
            raise ValueError(f"pictures in {self.folder}images are {images.shape[1:3]}, their maps {shape}")
        return np.ascontiguousarray(images.transpose(0, 3, 1, 2))

    def _stack(self, files: list[str], modes: tuple[str, ...]) -> np.ndarray:
        known = set(self.source.files)
        arrays = []
        for file in files:
            if file not in known:
                raise ValueError(f"{self.source.path} has no {file}, which params.csv calls for")
            try:
                with Image.open(io.BytesIO(self.source.read(file))) as picture:
                    mode, array = picture.mode, np.asarray(picture)
            except DECODER_ERRORS as problem:
                raise ValueError(f"{file} in {self.source.path} cannot be read: {problem}") from problem
            if mode not in modes or (arrays and array.shape != arrays[0].shape):
                raise ValueError(
                    f"{file} in {self.source.path} is {mode} {array.shape}; "
                    f"expected {modes[0]}, and all of one size"
                )
            arrays.append(array)
        return np.stack(arrays)
