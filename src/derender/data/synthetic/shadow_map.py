"""Shadow maps of generated meshes: how near to a lamp the nearest surface is, seen along its light."""

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from derender.data.synthetic.lighting import TEXELS, Lighting, axes_about
from derender.data.synthetic.mesh_image import TriangleMesh, fill_triangles


def lit_by(
    mesh: TriangleMesh, rotation: Float32[ndarray, "3 3"], translation: Float32[ndarray, "3"],
    ambient: float, lamps: Float32[ndarray, "lamps 4"], gloss: Float32[ndarray, "2"],
    haze: Float32[ndarray, "2"], shadows: bool, image_size: int,
) -> Lighting:  # fmt: skip
    """The light of one image of a mesh, with shadow maps if requested; ``lamps`` as in ``Lighting``."""
    centre = (translation + np.array([0, 0, 1], np.float32)).astype(np.float32)
    none = np.zeros((0, 0, 0), np.float32)
    across = np.zeros((len(lamps), 2, 3), np.float32)
    lighting = Lighting(np.float32(ambient), lamps, gloss, haze, across, centre, none)
    if not shadows:
        return lighting
    points = mesh.vertices @ rotation.T
    size = TEXELS * image_size
    scale = 0.48 * size / max(float(np.linalg.norm(points, axis=1).max()), 1e-6)
    maps = np.zeros((len(lamps), size, size), np.float32)
    for number, lamp in enumerate(lamps):
        across[number] = scale * axes_about(lamp[1:].astype(float))
        places = np.empty((len(points), 3), np.float32)
        places[:, :2] = points @ across[number].T + 0.5 * (size - 1)
        places[:, 2] = 1 - points @ lamp[1:]
        more, holes = np.zeros((len(points), 8), np.float32), np.zeros((0, 2, 3), np.float32)
        owner = np.empty(maps[number].shape, np.int32)
        fill_triangles(places, mesh.triangles, mesh.number[:0], more, holes, maps[number], owner)
    return lighting._replace(maps=maps)
