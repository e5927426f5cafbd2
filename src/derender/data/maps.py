"""Images with a map of every pixel: masks of classes, and the exact depth, normals and albedo of a rendering.

Masks are only ever resized to the nearest value, after the same crop as their image's. A mask in parts is
merged as CelebAMask-HQ's owners do it (their g_mask.py): a later class hides an earlier one. Leaves out
colours as classes, and a number for pixels without a class.

Exact maps are in the camera frame of their image (conventions.md). With a params.csv depth is z = 0.8 + value
/ 65535 * 0.4, normals (n + 1) / 2 * 255. 0 is background. Of depth maps alone (unsup3d's synthetic faces) a
share v of the largest value is z = 1.1 - 0.2 v. The set does not state this; data-sets.md has a check.
"""

import io
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image

from derender.data.image import DECODER_ERRORS, fit_square, quiet_pillow, upright_size
from derender.data.image_set import ImageSet, read_images
from derender.data.layouts import layout_named
from derender.data.layouts.faces import MASK_CLASSES, parts_of
from derender.data.layouts.layout import Labels, Table, half_of
from derender.data.layouts.rendered import CAMERA, LIGHT, pairs_of, rendered_folders
from derender.data.opening import ListedStream, half_named, open_images, open_source, parse_source
from derender.data.source import Source, stem_of
from derender.data.stream import Progress, usable_cores
from derender.storage.bounded import read_bounded

CLASSES_FILE = "classes.txt"
DEPTH_RANGE = (0.9, 1.1)


class MaskedImages(NamedTuple):
    """Images, the class number of every pixel, a row for each image, and the name of every class number."""

    images: ImageSet
    masks: UInt8[np.ndarray, "n s s"]
    classes: tuple[str, ...]


@dataclass(frozen=True)
class GroundTruth:
    """N rendered images with everything that made them; maps are 0 in the background."""

    images: UInt8[np.ndarray, "n 3 h w"]  # RGB
    depth: Float32[np.ndarray, "n h w"]  # z in the camera frame
    normal: Float32[np.ndarray, "n h w 3"] | None  # inward unit normals in the camera frame
    albedo: Float32[np.ndarray, "n 3 h w"] | None  # 0..1
    mask: Bool[np.ndarray, "n h w"]  # true on the object
    light: Float32[np.ndarray, "n 4"] | None  # ambient, diffuse, pitch, yaw (radians, canonical frame)
    camera: Float32[np.ndarray, "n 6"] | None  # rotation about x, y, z (radians), translation (z is 0)
    files: tuple[str, ...]  # relative to the source
    labels: Labels  # the other columns (identity, expression, class, ...)

    def __len__(self) -> int:
        return len(self.files)


def read_masks(
    source: str | Path, image_size: int, *, masks: str | Path | None = None, dataset: str = "auto",
    subset: str | None = None, limit: int | None = None, fit: str = "crop", workers: int | None = None,
    progress: Progress | None = None, **reading: Any,
) -> MaskedImages:  # fmt: skip
    """Read every image of a folder or zip with its mask, both at ``image_size`` x ``image_size``.

    The other options are those of ``read_images``; ``progress`` counts the images and then, from the start,
    the masks. A data set without masks is an error, and so is a mask that does not fit its image: one that is
    missing, is no image of one channel, or holds a number that is no class.

    Args:
        masks: a folder or zip with a mask for every image: that of ``a/b.jpg`` is ``a/b.png``, or the only
            ``b.png`` there is. A file ``classes.txt`` names the classes, one a line from number 0 on; it lies
            among them, or beside their folder. Without it classes have their numbers. None takes the data
            set's own masks, with CelebAMask-HQ's classes and the aspect ratio of their images.
    """
    own = masks is None
    with ExitStack() as opened:
        stream = opened.enter_context(open_images(source, dataset=dataset, subset=subset, limit=limit))
        if not own:
            files = opened.enter_context(open_source(Path(masks).expanduser()))
        elif isinstance(stream, ListedStream) and "mask" in stream.table.labels:
            files = stream.files
            _require_masks(files, stream.table.files, stream.table.labels["mask"].tolist())
        else:
            expected = "images/NAME.jpg with masks/NAME.png, or CelebA-HQ-img with CelebAMask-HQ-mask-anno"
            read_as = f"it was read as {stream.layout}"
            raise ValueError(f"{stream.source} holds no masks ({read_as}): expected {expected}")
        classes = len(MASK_CLASSES) if own else 255  # which marks pixels without a class in many sets
        named = f"0 ({MASK_CLASSES[0]}) to {classes - 1} ({MASK_CLASSES[-1]})"
        limits = named if own else f"0 to {classes - 1}: give pixels without a class a class of their own"
        images = read_images(stream, image_size, fit=fit, workers=workers, progress=progress, **reading)
        names = images.label("mask").tolist() if own else _named_alike(files, images.files)
        _require_masks(files, images.files, names)
        parts = parts_of(files) if own else {}
        result = np.empty((len(images), image_size, image_size), np.uint8)

        def load(row: int) -> None:
            name = names[row]
            mask = _merged(files, parts[name]) if name in parts else _numbers(files, name, classes, limits)
            if own:
                width, height = upright_size(files.read(image := images.files[row]))
                rows, columns = mask.shape
                if abs(columns * height - rows * width) > width + height:
                    both = f"{columns} x {rows} and its image {image} {width} x {height}"
                    rule = "a mask has the aspect ratio of its image"
                    raise ValueError(f"{name} in {files.path} is {both}: {rule}")
            square = fit_square(Image.fromarray(mask), image_size, fit, Image.Resampling.NEAREST, 0)
            result[row] = np.asarray(square)

        with ThreadPoolExecutor(workers or usable_cores()) as pool, quiet_pillow():
            for done, _ in enumerate(pool.map(load, range(len(images))), 1):
                if progress is not None:
                    progress(done, len(images))
        return MaskedImages(images, result, MASK_CLASSES if own else _class_names(files, result, names))


def read_ground_truth(
    source: str | Path, subset: str | None = None, *, limit: int | None = None, image_size: int | None = None
) -> GroundTruth:
    """Read the images of a rendered set that have a depth map.

    Args:
        source: a folder or zip in synface64's format or with folders ``image`` and ``depth``, or
            ``PATH::SUBSET``.
        subset: "test_gt" or "test" by default, or the only subset there is.
        limit: at most so many, evenly spaced.
        image_size: side to bring images and maps to, where the set is images beside depth maps alone. A set
            in synface64's format is read at the size it was rendered in.
    """
    place, named, options = parse_source(source)
    with open_source(Path(place).expanduser()) as opened:
        pairs = {} if rendered_folders(opened) else pairs_of(opened)
        layout = layout_named("depth_pairs" if pairs else "synface")
        layout = replace(layout, default_parts=("test_gt", "test", "train"))
        table = half_of(layout.read(opened, subset or named), half_named(source, options))
        if pairs:
            return _read_pairs(opened, {file: pairs[file] for file in table.at_most(limit).files}, image_size)
        return _read_maps(opened, table, limit)


def _require_masks(source: Source, images: Sequence[str], masks: Sequence[str]) -> None:
    """Every image has a mask in the source, or an error says how many have none."""
    if bare := [image for image, mask in zip(images, masks, strict=True) if not mask]:
        what = f"{len(bare):,} of {len(images):,} images have no mask in {source.path}"
        fix = "add the masks (NAME.png for NAME.jpg), or take these images out"
        raise ValueError(f"{what}, the first is {bare[0]!r}; {fix}")


def _numbers(source: Source, file: str, classes: int, limits: str) -> UInt8[np.ndarray, "h w"]:
    """A mask that holds class numbers; a palette's colours do not matter."""
    values, where = np.asarray(_opened(source, file)), f"{file} in {source.path}"
    if values.ndim > 2:
        raise ValueError(f"{where} has {values.shape[2]} channels; a mask has one, of class numbers")
    if values.min() < 0 or values.max() >= classes:
        wrong = int(values.min() if values.min() < 0 else values.max())
        raise ValueError(f"{where} holds the number {wrong}; classes are {limits}")
    return values.astype(np.uint8)


def _merged(source: Source, files: dict[int, str]) -> UInt8[np.ndarray, "h w"]:
    """The parts of one face, at least one, over one another, in the order of their class numbers."""
    parts = {number: np.asarray(_opened(source, files[number]).convert("L")) for number in sorted(files)}
    merged = np.zeros(next(iter(parts.values())).shape, np.uint8)
    for number, part in parts.items():
        if part.shape != merged.shape:
            size = f"{part.shape[1]} x {part.shape[0]}"
            raise ValueError(f"{files[number]} in {source.path} is {size}, other parts of the face are not")
        merged[part > 0] = number
    return merged


def _named_alike(source: Source, images: tuple[str, ...]) -> list[str]:
    """The mask of every image by its path, else by its name where that is the only one."""
    by_path = {file.removesuffix(".png"): file for file in source.files if file.endswith(".png")}
    times = Counter(map(stem_of, by_path.values()))
    only = {stem_of(file): file for file in by_path.values() if times[stem_of(file)] == 1}
    return [by_path.get(image.rpartition(".")[0]) or only.get(stem_of(image), "") for image in images]


def _class_names(source: Source, masks: UInt8[np.ndarray, "n s s"], files: list[str]) -> tuple[str, ...]:
    largest = masks.max(axis=(1, 2))
    listed, beside = source.named(CLASSES_FILE), source.path.parent / CLASSES_FILE
    if listed is not None:
        text = source.read_text(listed)
    elif source.path.is_dir() and beside.is_file():
        listed, text = str(beside), read_bounded(beside).decode("utf-8", "replace")
    else:
        return tuple(f"class {number}" for number in range(int(largest.max()) + 1))
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if (most := int(largest.max())) >= len(names):
        where = f"{files[int(largest.argmax())]} in {source.path}"
        raise ValueError(f"{where} holds the number {most}; {listed} names {len(names)} classes")
    return names


def _read_maps(source: Source, table: Table, limit: int | None) -> GroundTruth:
    """The images of a set in synface64's format, in the order of their names."""
    known = set(source.files)

    def map_names(kind: str) -> list[str]:
        return [f"{file.rpartition('images/')[0]}{kind}/{stem_of(file)}.png" for file in table.files]

    with_depth = np.flatnonzero([name in known for name in map_names("depth")])
    if not len(with_depth):
        expected = "".join(map_names("depth")[:1])
        raise ValueError(f"{source.path} has no depth maps for its images (expected {expected})")
    table = table.select(with_depth).at_most(limit)
    if missing := [name for name in (*LIGHT, *CAMERA) if name not in table.labels]:
        raise ValueError(f"the params.csv in {source.path} lacks the column for {missing[0]!r}")

    def maps(kind: str, *modes: str) -> np.ndarray | None:
        """The maps of a kind as they are stored, all of one mode and size, or None where there is none."""
        names, arrays = map_names(kind) if kind else table.files, []
        if known.isdisjoint(names):
            return None
        for name in names:
            if name not in known:
                raise ValueError(f"{source.path} has no {name}, which other images have")
            opened = _opened(source, name)
            array = np.asarray(opened)
            if opened.mode not in modes or (arrays and array.shape != arrays[0].shape):
                what = f"{name} in {source.path} is {opened.mode} {array.shape}"
                raise ValueError(f"{what}; expected {modes[0]}, and all of one size")
            arrays.append(array)
        return np.stack(arrays)

    code, mask, images = maps("depth", "I;16", "I"), maps("mask", "L"), maps("", "RGB")
    normal, albedo = maps("normal", "RGB"), maps("albedo", "RGB")
    if code is None or mask is None or images is None:
        raise ValueError(f"{source.path} has no masks for its depth maps")
    if images.shape[:3] != mask.shape:
        raise ValueError(f"images in {source.path} are {images.shape[1:3]}, their maps {mask.shape[1:]}")
    mask = mask > 127
    if normal is not None:
        normal = normal.astype(np.float32) / 255 * 2 - 1
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        normal *= mask[..., None]
    if albedo is not None:
        albedo = _channels_first(albedo).astype(np.float32) / 255
    images, depth = _channels_first(images), np.where(code > 0, 0.8 + code / 65535 * 0.4, 0)
    camera, light = (np.stack([table.labels[name] for name in names], axis=1) for names in (CAMERA, LIGHT))
    labels = {name: one for name, one in table.labels.items() if name not in (*LIGHT, *CAMERA, "mask")}
    result = images, depth.astype(np.float32), normal, albedo, mask, light, np.pad(camera, ((0, 0), (0, 1)))
    return GroundTruth(*result, table.files, labels)


def _read_pairs(source: Source, pairs: dict[str, str], image_size: int | None) -> GroundTruth:
    """Images beside depth maps: neither normals nor albedo, light and camera are known."""
    images, depths = [], []
    for file, map_file in pairs.items():
        depth = _read_depth(source, map_file, image_size)
        image = _opened(source, file).convert("RGB")
        if image.width != image.height:
            raise ValueError(f"{file} in {source.path} is {image.size}: images with depth must be square")
        if image_size is not None:
            image = image.resize((image_size, image_size), Image.Resampling.BOX)
        if not (image.height, image.width) == depth.shape == (depths or [depth])[0].shape:
            sizes = f"{image.size}, its map {map_file} {depth.shape[::-1]}"
            rule = "both must have one size, the same in the whole set; or give image_size"
            raise ValueError(f"{file} in {source.path} is {sizes}: {rule}")
        images.append(np.asarray(image))
        depths.append(depth)
    depth, whole = np.stack(depths), _channels_first(np.stack(images))
    return GroundTruth(whole, depth, None, None, depth > 0, None, None, files=tuple(pairs), labels={})


def _read_depth(source: Source, file: str, size: int | None) -> Float32[np.ndarray, "h w"]:
    """One depth map, z with 0 for background; at ``size`` if given, by area over the object's pixels."""
    opened = _opened(source, file)
    mode, code = opened.mode, np.asarray(opened)
    if mode == "RGB" and (code == code[..., :1]).all():
        code = code[..., 0]
    if code.ndim != 2 or mode not in ("L", "RGB", "I;16", "I"):
        what = f"{file} in {source.path} is {mode} {code.shape}"
        raise ValueError(f"{what}; a depth map is a grey PNG of 8 or 16 bits")
    (near, far), mask = DEPTH_RANGE, code > 0
    nearness = code / (255 if code.dtype == np.uint8 else 65_535)
    depth = np.where(mask, far - (far - near) * nearness, 0).astype(np.float32)
    if size is None or depth.shape == (size, size):
        return depth
    whole = [Image.fromarray(one.astype(np.float32)) for one in (depth, mask)]
    by_area, share = (np.asarray(one.resize((size, size), Image.Resampling.BOX)) for one in whole)
    small = share > 0.5  # a pixel is on the object where more than half of it is
    return np.where(small, by_area / np.where(small, share, 1), 0).astype(np.float32)


def _opened(source: Source, file: str) -> Image.Image:
    """A map or mask as it is stored, decoded; one that cannot be read is an error that names it."""
    try:
        opened = Image.open(io.BytesIO(source.read(file)))
        opened.load()
        return opened
    except DECODER_ERRORS as problem:
        raise ValueError(f"{file} in {source.path} cannot be read: {problem}") from problem


def _channels_first(code: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(code.transpose(0, 3, 1, 2))
