"""A user's own morphable model instead of the built-in faces: a documented .npz file.

    mean          (V, 3)     mean shape: x to the right of the image, y UP, z towards the viewer; any unit
    triangles     (F, 3)     vertex numbers, counter-clockwise seen from outside
    components    (K, V, 3)  displacement by each component
    std           (K,)       spread of its coefficient among people
    texture_mean  (V, 3)     optional: RGB reflectance 0..1; else each identity has a plain skin colour
    texture_components (T, V, 3), texture_std (T,)   optional
    parts         (V,)       optional: CelebAMask-HQ class number of each vertex; else all is skin (1)
    colours       (V, 3)     optional: RGB where a part has its own colour (eyes, teeth); NaN elsewhere
    expressions   (E, V, 3)  optional: displacement of each expression at full strength
    expression_names (E,)    optional: names from neutral happiness sadness surprise anger disgust fear
    unit          ()         optional: how many of the file's units span the image at z = 1
    centre        (3,)       optional: the point that lies in the middle of the image

The nose tip (the front-most vertex of the mean) is brought to z = 0.947 as in the built-in faces. Without
``unit`` the mean's width fills 0.9 of the image, without ``centre`` its bounding box is centred. Eyes do
not look around and lids do not move unless the expressions say so.
"""

import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from numpy import ndarray

from derender.data import MASK_CLASSES
from derender.data.synthetic.face_draw import NOSE_TIP_Z, FaceDraw
from derender.data.synthetic.face_identity import draw_identity
from derender.data.synthetic.settings import EXPRESSIONS, FaceSettings

_PICTURE_WIDTH = 2.0 * float(np.tan(np.deg2rad(5.0)))  # scene units across the image at z = 1
_LIMIT = 2.5
_REQUIRED = ("mean", "triangles", "components", "std")
Arrays = dict[str, ndarray]
_DAMAGED = (
    *(OSError, ValueError, AttributeError, LookupError, EOFError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
_SKIN = MASK_CLASSES.index("skin")


@dataclass(frozen=True)
class MorphablePerson:
    """One identity: canonical surface in scene units, albedo, and the coefficients that made them."""

    surface: Float32[ndarray, "v 3"]
    albedo: Float32[ndarray, "v 3"]
    coefficients: Float32[ndarray, "k"]
    melanin: float


@dataclass(frozen=True)
class MorphableFaces:
    """A morphable model in scene units and the project's frame (x right, y down, z away); see the module."""

    mean: Float32[ndarray, "v 3"]
    triangles: Int32[ndarray, "f 3"]
    components: Float32[ndarray, "k v 3"]
    std: Float32[ndarray, "k"]
    texture_mean: Float32[ndarray, "v 3"] | None
    texture_components: Float32[ndarray, "t v 3"]
    texture_std: Float32[ndarray, "t"]
    parts: UInt8[ndarray, "v"]
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
        except _DAMAGED as problem:
            raise ValueError(f"{path} cannot be read as .npz: {problem}") from problem
        try:
            return _checked(arrays)
        except ValueError as problem:
            raise ValueError(f"{path}: {problem}") from problem

    def prepare(self) -> None:
        """Nothing is computed lazily."""

    def person(self, seed: int, identity: int, settings: FaceSettings) -> MorphablePerson:
        """One identity: coefficients from normals clipped at 2.5 sd."""
        generator = np.random.default_rng([seed, 2, identity])
        normal = np.clip(generator.standard_normal(len(self.std)), -_LIMIT, _LIMIT)
        coefficients = (normal * self.std).astype(np.float32)
        who = draw_identity(generator, (), settings.age_years, settings.skin_tone)
        surface = self.mean.copy()
        for weight, component in zip(coefficients, self.components, strict=True):
            surface += weight * component
        plain = np.broadcast_to(who.skin.astype(np.float32), self.mean.shape)
        albedo = (plain if self.texture_mean is None else self.texture_mean).copy()
        for component, sd in zip(self.texture_components, self.texture_std, strict=True):
            albedo += np.float32(np.clip(generator.standard_normal(), -_LIMIT, _LIMIT) * sd) * component
        own = np.isfinite(self.colours).all(axis=1)
        albedo[own] = self.colours[own]
        return MorphablePerson(surface, np.clip(albedo, 0.0, 1.0), coefficients, who.melanin)

    def traits(self, person: MorphablePerson) -> dict[str, float | str]:
        return {f"shape_{k:03d}": float(value) for k, value in enumerate(person.coefficients)}

    def labels(self, person: MorphablePerson) -> dict[str, float | str]:
        return {} if self.texture_mean is not None else {"skin_tone": round(person.melanin, 4)}

    def meshes(
        self, draws: list[FaceDraw], people: dict[int, MorphablePerson]
    ) -> tuple[Float32[ndarray, "n v 3"], Float32[ndarray, "n v 3"], UInt8[ndarray, "n v"]]:
        """Canonical vertices in scene units, their albedo and their part, one mesh per draw."""
        vertices = np.stack([people[d.identity].surface for d in draws])
        for row, draw in zip(vertices, draws, strict=True):
            if draw.expression in self.expressions:
                row += np.float32(draw.strength) * self.expressions[draw.expression]
        albedo = np.stack([people[d.identity].albedo for d in draws])
        return vertices, albedo, np.stack([self.parts] * len(draws))


def _checked(arrays: Arrays) -> MorphableFaces:
    for name in _REQUIRED:
        if name not in arrays:
            there = ", ".join(sorted(arrays)) or "none"
            raise ValueError(f"the array {name!r} is missing; there are {there}")
    mean = _floats(arrays, "mean", (-1, 3))
    v = len(mean)
    triangles = np.asarray(arrays["triangles"])
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"triangles must be whole numbers (F, 3), got {triangles.dtype} {triangles.shape}")
    low, high = triangles.min(initial=v), triangles.max(initial=-1)
    if low < 0 or high < 0 or high >= v:
        raise ValueError(f"triangles must number vertices 0..{v - 1}, got {low}..{high}")
    components = _floats(arrays, "components", (-1, v, 3))
    low, high = mean.min(axis=0), mean.max(axis=0)
    unit = float(arrays["unit"] if "unit" in arrays else (high[0] - low[0]) / 0.9)
    if not unit > 0:
        raise ValueError(f"unit must be above 0, got {unit}")
    scale = np.array([1.0, -1.0, -1.0]) * (_PICTURE_WIDTH / unit)
    placed = (mean - _floats(arrays, "centre", (3,), 0.5 * (low + high))) * scale
    placed[:, 2] += NOSE_TIP_Z - placed[:, 2].min()
    textured = "texture_mean" in arrays
    texture = _floats(arrays if textured else {}, "texture_components", (-1, v, 3), np.zeros((0, v, 3)))
    texture_std = _floats(arrays, "texture_std", (len(texture),)) if len(texture) else np.zeros(0)
    return MorphableFaces(
        mean=placed.astype(np.float32),
        triangles=np.ascontiguousarray(triangles[:, ::-1], np.int32),  # clockwise in the image
        components=(components * scale).astype(np.float32),
        std=_floats(arrays, "std", (len(components),)).astype(np.float32),
        texture_mean=_within(_floats(arrays, "texture_mean", (v, 3)), "texture_mean") if textured else None,
        texture_components=texture.astype(np.float32),
        texture_std=texture_std.astype(np.float32),
        parts=_parts(arrays, v),
        colours=_within(_floats(arrays, "colours", (v, 3), np.full((v, 3), np.nan), True), "colours"),
        expressions=_expressions(arrays, v, scale),
    )


def _floats(
    arrays: Arrays, name: str, shape: tuple[int, ...], default: ndarray | None = None, holes: bool = False
) -> ndarray:
    """The array, checked; -1 in ``shape`` is any size, ``holes`` allows NaN."""
    array = arrays.get(name, default)
    if array is None:
        raise ValueError(f"the array {name!r} is missing")
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(
        size in (-1, got) for size, got in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "fiu":
        expected = ", ".join("any" if size < 0 else str(size) for size in shape)
        raise ValueError(f"{name} must be numbers of shape ({expected}), got {array.dtype} {array.shape}")
    if not holes and not np.isfinite(array).all():
        raise ValueError(f"{name} holds values that are not finite")
    return array.astype(np.float64)


def _within(colour: ndarray, name: str) -> Float32[ndarray, "v 3"]:
    low, high = np.nanmin(colour, initial=0.0), np.nanmax(colour, initial=0.0)
    if low < 0 or high > 1:
        raise ValueError(f"{name} must lie in 0..1, got {low:.3g}..{high:.3g}")
    return colour.astype(np.float32)


def _parts(arrays: Arrays, v: int) -> UInt8[ndarray, "v"]:
    parts, last = _floats(arrays, "parts", (v,), np.full(v, _SKIN)), len(MASK_CLASSES) - 1
    if parts.min() < 1 or parts.max() > last:
        raise ValueError(f"parts must be class numbers 1..{last}, got {parts.min():g}..{parts.max():g}")
    return parts.astype(np.uint8)


def _expressions(arrays: Arrays, v: int, scale: ndarray) -> dict[str, Float32[ndarray, "v 3"]]:
    fields = _floats(arrays, "expressions", (-1, v, 3), np.zeros((0, v, 3)))
    names = [str(name) for name in np.asarray(arrays.get("expression_names", ()))] if len(fields) else []
    if len(names) != len(fields) or not set(names) <= set(EXPRESSIONS):
        raise ValueError(
            f"expression_names must give one of {', '.join(EXPRESSIONS)} "
            f"for each of {len(fields)} expressions, got {names}"
        )
    return {name: (shape * scale).astype(np.float32) for name, shape in zip(names, fields, strict=True)}
