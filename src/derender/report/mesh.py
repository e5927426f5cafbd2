"""A scene's surface as a textured triangle mesh in glTF's axes, and the bytes of its files.

Axes change. A scene's x is right, y DOWN, z forward and its normals point inward (conventions.md). The mesh's
x is right, y UP, z towards the viewer and its normals point outward, as in glTF: the object looks along +z.
That is half a turn about x, (x, y, z) -> (x, -y, 1 - z): handedness stays, and the object's centre (0, 0, 1)
becomes the origin. Lengths stay scene units. Texture coordinates have their origin at the texture's lower
left corner. Cells of the pixel grid that are no surface are left out: border columns that the model holds at
one depth, and pieces apart from the largest. So are cells seen at a grazing angle (on a grid a jump in depth
is one) where they reach the rim. A steep flank inside the surface stays: without it the surface would have
holes. Values are stored as they are: images are sRGB-coded, as is a base colour in glTF. Leaves out closing
the back, several objects, and compressed geometry.
"""

import re
from dataclasses import dataclass, replace
from math import ceil, cos, radians
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from PIL import Image
from scipy import ndimage
from torch import Tensor

from derender.model import Derenderer
from derender.report.colours import pictures
from derender.report.opening import OpenedImage
from derender.report.options import MESH_FORMATS, MESH_SIZE
from derender.scene import Scene
from derender.scene.camera import unproject
from derender.scene.enlarge import at_size
from derender.scene.normals import normals_from_depth
from derender.storage.places import require_known

GRAZING_DEG = 85.0


@dataclass(frozen=True)
class Mesh:
    """A textured triangle mesh; x right, y up, z towards the viewer."""

    vertices: Float32[np.ndarray, "v 3"]  # (V, 3) scene units, the object's centre at the origin
    normals: Float32[np.ndarray, "v 3"]  # (V, 3) unit length, outward
    uv: Float32[np.ndarray, "v 2"]  # (V, 2) 0..1, from the lower left corner of the texture
    faces: Int64[np.ndarray, "f 3"]  # (F, 3) vertex numbers, counter-clockwise seen from outside
    texture: Image.Image  # albedo, first row at the top
    trimmed: float  # share of the grid's cells that were left out, 0..1
    form: str = "glb"  # of the files that `write` makes, one of ``MESH_FORMATS``
    row: ClassVar[dict[str, Image.Image]] = {}  # of a sheet: meshes have none

    def write(self, folder: Path, record: dict[str, Any]) -> dict[str, Any]:
        """Write the files; returns their names and the mesh's size."""
        home = Path(record["folder"])
        files = self.files(home.name, self.form)
        for name, content in files.items():
            (folder / name).write_bytes(content)
        size = {"vertices": len(self.vertices), "faces": len(self.faces), "trimmed": self.trimmed}
        return {**record, "files": [home / name for name in files], **size}

    def files(self, name: str, form: str = "glb") -> dict[str, bytes]:
        """File name to content: ``NAME.glb``, or ``NAME.obj``, ``NAME.mtl`` and ``NAME.png``.

        The material is the albedo without gloss, seen from both sides. OBJ knows no names with spaces; such
        characters become underscores.
        """
        require_known("format", form, MESH_FORMATS)
        import trimesh
        from trimesh.visual import TextureVisuals
        from trimesh.visual.material import PBRMaterial, SimpleMaterial

        how: dict[str, Any] = {"include_normals": True}
        if form == "glb":
            material = PBRMaterial(
                name="albedo", baseColorTexture=self.texture, metallicFactor=0.0, roughnessFactor=1.0,
                doubleSided=True,
            )  # fmt: skip
        else:
            black = [0] * 4
            material = SimpleMaterial(image=self.texture, diffuse=[255] * 4, ambient=black, specular=black)
            material.name = name = re.sub(r"[^\w.-]", "_", name)
            how |= {"return_texture": True, "mtl_name": f"{name}.mtl"}
        visual = TextureVisuals(uv=self.uv, material=material)
        shape: dict[str, Any] = {"vertex_normals": self.normals, "visual": visual, "process": False}
        content: Any = trimesh.Trimesh(self.vertices, self.faces, **shape).export(file_type=form, **how)
        if form == "glb":
            return {f"{name}.glb": content}
        text, beside = content
        return {f"{name}.obj": text.encode()} | {one: beside[one] for one in (f"{name}.mtl", f"{name}.png")}


def model_mesh(
    model: Derenderer, scene: Scene, grazing_deg: float = GRAZING_DEG,
    texture: Float[Tensor, "1 3 t t"] | None = None,
) -> Mesh:  # fmt: skip
    """The mesh of one scene of a model, enlarged or not, without the border held at one depth.

    Enlarging smooths the step at that border over one more of the model's columns. ``texture`` takes the
    albedo's place; it covers the model's pixels to their outer edges, and may have any size.
    """
    own, size = model.image_size, scene.depth.shape[-1]
    border = model.settings.ranges.border_columns(own)
    if border and size != own:
        border = ceil((border + 1) * (size - 1) / (own - 1))
    mesh = mesh_of(scene, model.fov_deg, border, grazing_deg)
    if texture is None:
        return mesh
    grid = mesh.uv * size - 0.5  # pixels of the scene, whose outermost centres are the model's
    uv = (grid * (own - 1) / (size - 1) + 0.5) / own
    return replace(mesh, uv=uv.astype(np.float32), texture=pictures(texture)[0])


def image_mesh(model: Derenderer, image: OpenedImage, grazing_deg: float, form: str) -> Mesh:
    """The mesh of an opened image, with its own pixels as texture where those are drawn."""
    scene, texture = image.scene, None
    if image.detail is not None:
        scene = at_size(scene, max(MESH_SIZE, model.image_size))
        texture = image.detail.albedo()
    return replace(model_mesh(model, scene, grazing_deg, texture), form=form)


def mesh_of(scene: Scene, fov_deg: float, border_columns: int = 0, grazing_deg: float = GRAZING_DEG) -> Mesh:
    """The mesh of one scene in its canonical view.

    Args:
        fov_deg: horizontal field of view.
        border_columns: pixel columns at each side that the model holds at one depth; they are left out.
        grazing_deg: cells whose surface is turned further from the viewer are left out, except those that the
            rest of the surface encloses.

    Raises:
        ValueError: nothing of the surface is left.
    """
    if not 0 < grazing_deg <= 90:
        raise ValueError(f"grazing must lie above 0 and up to 90 degrees, got {grazing_deg:g}")
    depth = scene.depth.detach().double().cpu()
    height, width = depth.shape[1:]
    points = unproject(depth, fov_deg)[0]
    inside = torch.ones(height - 1, width - 1, dtype=torch.bool)
    inside[:, :border_columns] = inside[:, width - 1 - border_columns :] = False
    cells = (inside & _facing(points, grazing_deg)).numpy()
    pieces = np.zeros(cells.shape, np.int32)
    ndimage.label(cells, output=pieces)
    if pieces.max() > 1:  # the largest, connected by sides, is the surface, with the holes in it filled
        cells = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    surface = np.asarray(ndimage.binary_fill_holes(cells))
    if not surface.any():
        fix = "allow more, or see whether the model was trained"
        raise ValueError(f"nothing of this surface is seen at less than {grazing_deg:g} degrees: {fix}")
    row, column = np.nonzero(surface)
    a = row * width + column
    b, c, d = a + width, a + 1, a + width + 1
    corners = np.concatenate((np.stack((a, b, c), axis=1), np.stack((c, b, d), axis=1)))
    used, faces = np.unique(corners, return_inverse=True)  # two triangles a cell, counter-clockwise
    to_gltf = np.array([1.0, -1.0, -1.0])
    vertices = (points.numpy().reshape(-1, 3) - (0, 0, 1)) * to_gltf
    outward = -normals_from_depth(depth, fov_deg)[0].numpy().reshape(-1, 3) * to_gltf
    row, column = np.divmod(used, width)
    uv = np.stack(((column + 0.5) / width, 1 - (row + 0.5) / height), axis=1)
    return Mesh(
        vertices[used].astype(np.float32),
        outward[used].astype(np.float32),
        uv.astype(np.float32),
        faces.reshape(-1, 3).astype(np.int64),
        pictures(scene.albedo.detach())[0],
        float(1 - surface.mean()),
    )


def _facing(points: Float[Tensor, "h w 3"], grazing_deg: float) -> Tensor:
    """Which cells (H-1, W-1) show both their triangles to the viewer at less than this angle."""
    a, c = points[:-1, :-1], points[:-1, 1:]
    b, d = points[1:, :-1], points[1:, 1:]
    facing = torch.ones(a.shape[:2], dtype=torch.bool)
    for corner, right, down in ((a, c - a, b - a), (d, d - b, d - c)):
        normal = torch.linalg.cross(right, down)  # inward, like every normal here
        cosine = (normal * corner).sum(dim=-1) / (normal.norm(dim=-1) * corner.norm(dim=-1))
        facing &= cosine > cos(radians(grazing_deg))
    return facing
