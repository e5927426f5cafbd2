"""ICT-FaceKit's published files to one .npz that `derender synth faces --model` takes.

    git clone https://github.com/USC-ICT/ICT-FaceKit      # MIT licence
    python examples/convert_ict_facekit.py ICT-FaceKit/FaceXModel ict.npz
    derender synth faces --model ict.npz --out made/

Reads ``generic_neutral_mesh.obj``, ``identity000.obj``, ``identity001.obj``, ... and the expression shapes by
their names (``mouthSmile_L.obj``, ...), all with the same vertices in the same order. Every identity file is
the neutral mesh plus one standard deviation of a component. The seven named expressions are mixed from the
shapes after the units of facial action coding. Vertex ranges (skin, teeth, eyes) are those of ICT-FaceKit's
README; films over the eye, lashes and the back of the skull are left out. There is no skin texture in the
published light model: each person gets a plain skin colour.
"""

import argparse
import itertools
import sys
from pathlib import Path

import numpy as np

from derender.data import MASK_CLASSES
from derender.storage.atomic import atomic_file

EXPRESSIONS = {
    "happiness": {
        "mouthSmile": 0.9,
        "cheekSquint": 0.6,
        "eyeSquint": 0.3,
        "mouthUpperUp": 0.25,
        "mouthDimple": 0.2,
    },
    "sadness": {
        "browInnerUp": 0.9,
        "mouthFrown": 0.9,
        "mouthShrugLower": 0.5,
        "browDown": 0.15,
        "eyeSquint": 0.2,
    },
    "surprise": {"browInnerUp": 0.9, "browOuterUp": 0.9, "eyeWide": 0.9, "jawOpen": 0.55},
    "anger": {"browDown": 1.0, "eyeSquint": 0.4, "noseSneer": 0.4, "mouthPress": 0.6, "mouthFrown": 0.3},
    "disgust": {"noseSneer": 1.0, "mouthUpperUp": 0.6, "browDown": 0.5, "eyeSquint": 0.4, "mouthFrown": 0.3},
    "fear": {"browInnerUp": 1.0, "browOuterUp": 0.4, "eyeWide": 0.9, "mouthStretch": 0.8, "jawOpen": 0.25},
}
RANGES = {  # first and last vertex: part, colour (None: skin)
    "face": (0, 9408, "skin", None),
    "head and neck": (9409, 11247, "skin", None),
    "mouth socket": (11248, 13293, "mouth", (0.30, 0.10, 0.10)),
    "eye sockets": (13294, 14061, "skin", None),
    "gums and tongue": (14062, 17038, "mouth", (0.60, 0.28, 0.27)),
    "teeth": (17039, 21450, "mouth", (0.87, 0.83, 0.76)),
    "left sclera": (21451, 22220, "l_eye", (0.86, 0.83, 0.81)),
    "left iris": (22221, 23020, "l_eye", (0.22, 0.14, 0.09)),
    "right sclera": (23021, 23790, "r_eye", (0.86, 0.83, 0.81)),
    "right iris": (23791, 24590, "r_eye", (0.22, 0.14, 0.09)),
}
PICTURE_CM = 16.6  # the mesh is in centimetres; as much as this spans the image
BEHIND_CM = 14.5  # points so far behind the nose tip are cut off


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description="ICT-FaceKit's FaceXModel folder to a morphable model in .npz"
    )
    parser.add_argument("folder", type=Path, help="the folder FaceXModel")
    parser.add_argument("out", type=Path, help="the .npz to write")
    parser.add_argument("--components", type=int, default=100, help="at most so many identity shapes")
    given = parser.parse_args(arguments)
    try:
        arrays = convert(given.folder, given.components)
    except (ValueError, FileNotFoundError) as problem:
        print(f"convert_ict_facekit: {problem}", file=sys.stderr)
        return 2
    with atomic_file(given.out) as path, path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    shape = arrays["components"].shape
    print(
        f"{given.out}: {shape[1]:,} vertices, {shape[0]} components, {len(arrays['triangles']):,} triangles"
    )
    return 0


def convert(folder: Path, most: int = 100) -> dict[str, np.ndarray]:
    """The arrays of the .npz, as derender.data.synthetic.morphable describes them."""
    neutral, triangles = read_obj(folder / "generic_neutral_mesh.obj")
    identities = sorted(folder.glob("identity[0-9][0-9][0-9].obj"))[:most]
    if not identities:
        raise FileNotFoundError(f"{folder} holds no identity000.obj: give ICT-FaceKit's folder FaceXModel")
    components = np.stack([_difference(path, neutral) for path in identities])
    expressions = {name: _mixed(folder, weights, neutral) for name, weights in EXPRESSIONS.items()}
    parts = np.zeros(len(neutral), np.uint8)
    colours = np.full((len(neutral), 3), np.nan, np.float32)
    for first, last, part, colour in RANGES.values():
        parts[first : last + 1] = MASK_CLASSES.index(part)
        if colour is not None:
            colours[first : last + 1] = colour
    nose_tip = neutral[neutral[:, 2].argmax()]
    kept = (parts > 0) & (neutral[:, 2] > nose_tip[2] - BEHIND_CM)
    number = np.cumsum(kept) - 1
    triangles = number[triangles[kept[triangles].all(axis=1)]]
    return {
        "mean": neutral[kept].astype(np.float32),
        "triangles": triangles.astype(np.int32),
        "components": components[:, kept].astype(np.float32),
        "std": np.full(len(components), 0.9, np.float32),
        "parts": parts[kept],
        "colours": colours[kept],
        "expressions": np.stack([shape[kept] for shape in expressions.values()]).astype(np.float32),
        "expression_names": np.array(list(expressions)),
        "unit": np.array(PICTURE_CM, np.float32),
        "centre": np.array([0.0, nose_tip[1] - 0.3, nose_tip[2]], np.float32),
    }


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of a Wavefront file; quads and larger faces are fanned out."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: give ICT-FaceKit's folder FaceXModel")
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in path.read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "f":
            corners = [int(word.split("/")[0]) - 1 for word in words]
            triangles += [(corners[0], b, c) for b, c in itertools.pairwise(corners[1:])]
    if not vertices:
        raise ValueError(f"{path} holds no vertices")
    return np.array(vertices), np.array(triangles, int).reshape(-1, 3)


def _mixed(folder: Path, weights: dict[str, float], neutral: np.ndarray) -> np.ndarray:
    """The weighted sum of shapes; a name stands for its left and right file, or for one file of that name."""
    total = np.zeros_like(neutral)
    for name, weight in weights.items():
        files = [
            path for path in (folder / f"{name}{side}.obj" for side in ("_L", "_R", "")) if path.is_file()
        ]
        if not files:
            raise FileNotFoundError(f"{folder} holds neither {name}.obj nor {name}_L.obj")
        total += weight * sum(_difference(path, neutral) for path in files)
    return total


def _difference(path: Path, neutral: np.ndarray) -> np.ndarray:
    vertices, _ = read_obj(path)
    if vertices.shape != neutral.shape:
        raise ValueError(f"{path} has {len(vertices):,} vertices, generic_neutral_mesh.obj {len(neutral):,}")
    return vertices - neutral


if __name__ == "__main__":
    sys.exit(main())
