"""A user's own morphable model instead of the built-in faces: the .npz file of docs/how-to/generate.md.

The nose tip (the front-most vertex of the mean) is brought to z = 0.947 as in the built-in faces. Without
``unit``, how many of the file's units span the image at z = 1, the mean's width fills 0.9 of the image.
Without ``centre`` its bounding box is centred. Without textures each identity has a plain skin colour. A
colour of NaN is none. Eyes do not look around and lids do not move unless the expressions say so.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray

from derender.data import MASK_CLASSES
from derender.data.image import DECODER_ERRORS
from derender.data.synthetic.face_identity import draw_identity
from derender.data.synthetic.mesh_image import TriangleMesh
from derender.data.synthetic.settings import EXPRESSIONS, FaceSettings
from derender.data.synthetic.synthetic_set import Row

NOSE_TIP_Z = 0.947  # of neutral faces
_PICTURE_WIDTH = 2.0 * float(np.tan(np.deg2rad(5.0)))  # scene units across the image at z = 1
_LIMIT = 2.5
MeshOf = Callable[[Any], TriangleMesh]


@dataclass(frozen=True)
class MorphableFaces:
    """A morphable model in scene units about (0, 0, 1) and the project's frame (x right, y down, z away); see
    the module."""

    mean: Float32[ndarray, "v 3"]
    triangles: Int32[ndarray, "f 3"]
    components: Float32[ndarray, "k v 3"]
    std: Float32[ndarray, "k"]
    texture_mean: Float32[ndarray, "v 3"] | None
    texture_components: Float32[ndarray, "t v 3"]
    texture_std: Float32[ndarray, "t"]
    parts: Int32[ndarray, "v"]
    colours: Float32[ndarray, "v 3"]  # NaN where a part has no colour of its own
    expressions: dict[str, Float32[ndarray, "v 3"]]

    @staticmethod
    def read(path: str | Path) -> "MorphableFaces":
        """Read and check a file; every ValueError names the file, the array and what was expected."""
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist: expected a morphable model as .npz")
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
        except DECODER_ERRORS as problem:
            raise ValueError(f"{path} cannot be read as .npz: {problem}") from problem
        try:
            return _checked(arrays)
        except ValueError as problem:
            raise ValueError(f"{path}: {problem}") from problem

    def person(self, seed: int, identity: int, settings: FaceSettings) -> tuple[MeshOf, Row, Row]:
        """One identity, its coefficients from normals clipped at 2.5 sd: its mesh by expression (of ``name``
        and ``strength``), labels, and traits for tables."""
        generator = np.random.default_rng([seed, 2, identity])
        normal = np.clip(generator.standard_normal(len(self.std)), -_LIMIT, _LIMIT)
        coefficients = (normal * self.std).astype(np.float32)
        who = draw_identity(generator, (), settings.age_years, settings.skin_tone)
        surface = self.mean + np.tensordot(coefficients, self.components, 1)
        albedo = self.texture_mean if self.texture_mean is not None else who["skin"].astype(np.float32)
        normal = np.clip(generator.standard_normal(len(self.texture_std)), -_LIMIT, _LIMIT)
        weights = (normal * self.texture_std).astype(np.float32)
        albedo = albedo + np.tensordot(weights, self.texture_components, 1)
        own = np.isfinite(self.colours).all(axis=1, keepdims=True)
        albedo = np.clip(np.where(own, self.colours, albedo), 0.0, 1.0)
        labels: Row = {} if self.texture_mean is not None else {"skin_tone": round(who["melanin"], 4)}
        traits: Row = {f"shape_{k:03d}": float(value) for k, value in enumerate(coefficients)}
        known, still = self.expressions, np.zeros(3, np.float32)

        def mesh(expression: Any) -> TriangleMesh:
            moved = surface + np.float32(expression.strength) * known.get(expression.name, still)
            return TriangleMesh(moved, self.triangles, albedo, self.parts)

        return mesh, labels, traits


def _checked(arrays: dict[str, ndarray]) -> MorphableFaces:
    for name in ("mean", "triangles", "components", "std"):
        if name not in arrays:
            there = ", ".join(sorted(arrays)) or "none"
            raise ValueError(f"the array {name!r} is missing; there are {there}")

    def floats(
        name: str, *shape: int, default: Any = None, holes: bool = False, unit: bool = False
    ) -> ndarray:
        """The array or its default, checked; -1 is any size, ``holes`` allows NaN, ``unit`` 0..1 alone."""
        array = np.asarray(arrays.get(name, default))
        fits = len(shape) == array.ndim and all(a in (-1, b) for a, b in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in "fiu":
            expected = ", ".join("any" if size < 0 else str(size) for size in shape)
            raise ValueError(f"{name} must be numbers of shape ({expected}), got {array.dtype} {array.shape}")
        if not holes and not np.isfinite(array).all():
            raise ValueError(f"{name} holds values that are not finite")
        low, high = np.nanmin(array, initial=0.0), np.nanmax(array, initial=0.0)
        if unit and (low < 0 or high > 1):
            raise ValueError(f"{name} must lie in 0..1, got {low:.3g}..{high:.3g}")
        return array.astype(np.float64)

    mean, triangles = floats("mean", -1, 3), np.asarray(arrays["triangles"])
    v = len(mean)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"triangles must be whole numbers (F, 3), got {triangles.dtype} {triangles.shape}")
    low, high = triangles.min(initial=v), triangles.max(initial=-1)
    if low < 0 or high < 0 or high >= v:
        raise ValueError(f"triangles must number vertices 0..{v - 1}, got {low}..{high}")
    components = floats("components", -1, v, 3)
    low, high = mean.min(axis=0), mean.max(axis=0)
    unit = float(arrays["unit"] if "unit" in arrays else (high[0] - low[0]) / 0.9)
    if not unit > 0:
        raise ValueError(f"unit must be above 0, got {unit}")
    scale = np.array([1.0, -1.0, -1.0]) * (_PICTURE_WIDTH / unit)
    placed = (mean - floats("centre", 3, default=0.5 * (low + high))) * scale
    placed[:, 2] += NOSE_TIP_Z - placed[:, 2].min()
    textured, none = "texture_mean" in arrays, np.zeros((0, v, 3))
    texture = floats("texture_components", -1, v, 3, default=none) if textured else none
    parts, last = floats("parts", v, default=np.full(v, MASK_CLASSES.index("skin"))), len(MASK_CLASSES) - 1
    if parts.min() < 1 or parts.max() > last:
        raise ValueError(f"parts must be class numbers 1..{last}, got {parts.min():g}..{parts.max():g}")
    expressions = floats("expressions", -1, v, 3, default=none) * scale
    names = [str(name) for name in np.asarray(arrays.get("expression_names", ()))] if len(expressions) else []
    if len(names) != len(expressions) or not set(names) <= set(EXPRESSIONS):
        needed = f"one of {', '.join(EXPRESSIONS)} for each of {len(expressions)} expressions"
        raise ValueError(f"expression_names must give {needed}, got {names}")
    colours = floats("colours", v, 3, default=np.full((v, 3), np.nan), holes=True, unit=True)
    return MorphableFaces(
        mean=placed.astype(np.float32) - np.array([0, 0, 1], np.float32),
        triangles=np.ascontiguousarray(triangles[:, ::-1], np.int32),  # clockwise in the image
        components=(components * scale).astype(np.float32),
        std=floats("std", len(components)).astype(np.float32),
        texture_mean=floats("texture_mean", v, 3, unit=True).astype(np.float32) if textured else None,
        texture_components=texture.astype(np.float32),
        texture_std=(floats("texture_std", len(texture)) if len(texture) else np.zeros(0)).astype(np.float32),
        parts=parts.astype(np.int32),
        colours=colours.astype(np.float32),
        expressions=dict(zip(names, expressions.astype(np.float32), strict=True)),
    )
