"""A mesh as the bytes of files: GLB (one file), or OBJ with its material and texture.

Written by trimesh, so that whatever reads glTF 2.0 or Wavefront OBJ reads them. The material is the albedo
without gloss, seen from both sides. Values are stored as they are: pictures are sRGB-coded, and so does glTF
take a base colour. Leaves out scenes of several objects and compressed geometry.
"""

import io
import re
from typing import Any

import numpy as np

from derender.data import suggestion
from derender.report.mesh import Mesh

FORMATS = ("glb", "obj")


def mesh_files(mesh: Mesh, name: str, form: str = "glb") -> dict[str, bytes]:
    """File name to content: ``NAME.glb``, or ``NAME.obj``, ``NAME.mtl`` and ``NAME.png``.

    OBJ knows no names with spaces; such characters become underscores.
    """
    if checked_format(form) == "glb":
        return {f"{name}.glb": _glb(mesh)}
    return _obj(mesh, re.sub(r"[^\w.-]", "_", name))


def checked_format(form: str) -> str:
    """The format itself; an unknown one is an error that names the nearest."""
    if form not in FORMATS:
        raise ValueError(f"unknown format {form!r}{suggestion(form, FORMATS)}; there is {', '.join(FORMATS)}")
    return form


def _glb(mesh: Mesh) -> bytes:
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    material = PBRMaterial(
        name="albedo",
        baseColorTexture=mesh.texture,
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    visual = TextureVisuals(uv=mesh.uv, material=material)
    made: Any = trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, visual=visual, process=False
    )
    return bytes(export_glb(trimesh.Scene(made), include_normals=True))


def _obj(mesh: Mesh, name: str) -> dict[str, bytes]:
    """Written here, since trimesh chooses the names of material and texture itself."""
    lines = io.StringIO()
    lines.write(f"# x right, y up, z towards the viewer\nmtllib {name}.mtl\no {name}\nusemtl albedo\n")
    for word, rows in (("v", mesh.vertices), ("vt", mesh.uv), ("vn", mesh.normals)):
        np.savetxt(lines, rows, fmt=f"{word} " + " ".join(["%.7g"] * rows.shape[1]))
    numbers = mesh.faces + 1
    np.savetxt(lines, np.repeat(numbers, 3, axis=1), fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
    texture = io.BytesIO()
    mesh.texture.save(texture, format="PNG")
    material = f"newmtl albedo\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {name}.png\n"
    return {
        f"{name}.obj": lines.getvalue().encode(),
        f"{name}.mtl": material.encode(),
        f"{name}.png": texture.getvalue(),
    }
