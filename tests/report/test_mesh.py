"""Meshes as other programs read them: which way is up, what the texture shows, what is left out."""

import io

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from derender.report.mesh import mesh_of
from derender.scene import Scene

FOV_DEG = 10.0
SIZE = 24


def nosed() -> Scene:
    """A plane with a nose in the upper right of the image; nose red, upper half green, lower half blue."""
    axis = torch.linspace(-1, 1, SIZE)
    y, x = axis[:, None].expand(SIZE, SIZE), axis.expand(SIZE, SIZE)
    bump = torch.exp(-12 * ((x - 0.4) ** 2 + (y + 0.4) ** 2))
    albedo = torch.stack(((bump > 0.5).float(), (y < 0).float(), (y >= 0).float()))
    return Scene((1.0 - 0.03 * bump)[None], albedo[None], torch.ones(1, 4), torch.zeros(1, 6))


def opened(content: bytes, form: str, **more) -> trimesh.Trimesh:
    return trimesh.load(io.BytesIO(content), file_type=form, process=False, force="mesh", **more)


@pytest.fixture
def from_glb() -> trimesh.Trimesh:
    return opened(mesh_of(nosed(), FOV_DEG).files("one")["one.glb"], "glb")


def colour_at(mesh: trimesh.Trimesh, vertex: int, texture: Image.Image) -> np.ndarray:
    """The texture's colour at a vertex, as trimesh keeps it: v = 0 is the bottom."""
    u, v = mesh.visual.uv[vertex]
    return np.asarray(texture.convert("RGB"))[int((1 - v) * texture.height), int(u * texture.width)]


def test_axes_of_the_mesh(from_glb):
    nose = from_glb.vertices[:, 2].argmax()  # nearest to the viewer, who stands at +z
    assert (from_glb.vertices[nose][:2] > 0.02).all()  # right and up, as in the image
    assert from_glb.vertices[nose][2] == pytest.approx(0.03, abs=1e-3)
    assert np.abs(from_glb.vertices[:, 2].min()) < 1e-6  # the plane through the object's centre
    width = np.ptp(from_glb.vertices[:, 0])
    assert width == pytest.approx(2 * np.tan(np.radians(FOV_DEG / 2)), rel=1e-5)


def test_normals_and_faces_look_at_the_viewer(from_glb):
    assert (from_glb.vertex_normals[:, 2] > 0).all()
    assert (from_glb.face_normals[:, 2] > 0).all()  # from the order of the corners
    np.testing.assert_allclose(np.linalg.norm(from_glb.vertex_normals, axis=1), 1, atol=1e-5)
    right_of_nose = from_glb.vertices[:, 0] > 0.055
    high = np.abs(from_glb.vertices[:, 1] - 0.035) < 0.005
    assert from_glb.vertex_normals[right_of_nose & high][:, 0].mean() > 0.01  # the flank looks to the right


def test_texture_lies_the_right_way_up(from_glb):
    texture = from_glb.visual.material.baseColorTexture
    top, bottom = from_glb.vertices[:, 1].argmax(), from_glb.vertices[:, 1].argmin()
    assert colour_at(from_glb, top, texture).tolist() == [0, 255, 0]
    assert colour_at(from_glb, bottom, texture).tolist() == [0, 0, 255]
    nose = from_glb.vertices[:, 2].argmax()
    assert colour_at(from_glb, nose, texture)[0] == 255


def test_glb_holds_every_vertex_and_face(from_glb):
    mesh = mesh_of(nosed(), FOV_DEG)
    assert len(from_glb.vertices) == SIZE**2 and len(from_glb.faces) == 2 * (SIZE - 1) ** 2
    np.testing.assert_allclose(from_glb.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_allclose(from_glb.visual.uv, mesh.uv, atol=1e-6)
    np.testing.assert_array_equal(from_glb.faces, mesh.faces)
    assert mesh.trimmed == 0


def test_obj_says_the_same(tmp_path):
    mesh = mesh_of(nosed(), FOV_DEG)
    files = mesh.files("a face", "obj")
    assert list(files) == ["a_face.obj", "a_face.mtl", "a_face.png"]
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    read = trimesh.load(tmp_path / "a_face.obj", process=False, force="mesh", maintain_order=True)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.visual.uv, mesh.uv, atol=1e-6)
    lines = files["a_face.obj"].decode().splitlines()  # trimesh makes normals of its own here
    normals = [line.split()[1:] for line in lines if line.startswith("vn ")]
    np.testing.assert_allclose(np.array(normals, float), mesh.normals, atol=1e-6)
    top = read.vertices[:, 1].argmax()
    assert colour_at(read, top, read.visual.material.image).tolist() == [0, 255, 0]


def test_borders_steps_and_scraps_are_left_out():
    scene = nosed()
    depth = scene.depth.clone()
    depth[:, :, :2] = depth[:, :, -2:] = 1.04  # the model's border
    depth[:, 20:, :] += 0.15  # a step, and beyond it a scrap
    whole = mesh_of(scene, FOV_DEG)
    cut = mesh_of(scene.with_parameters(depth=depth), FOV_DEG, border_columns=2)
    assert len(cut.vertices) == 20 * 20 and len(cut.faces) == 2 * 19 * 19
    assert cut.trimmed == pytest.approx(1 - 19 * 19 / 23**2)
    assert cut.uv[:, 0].min() == pytest.approx(2.5 / SIZE) and cut.uv[:, 1].min() == pytest.approx(4.5 / SIZE)
    assert np.ptp(cut.vertices[:, 2]) < 0.04 < np.ptp(depth.numpy())
    assert len(np.unique(cut.faces)) == len(cut.vertices) < len(whole.vertices)


def test_a_steep_flank_inside_makes_no_hole():
    scene = nosed()
    depth = scene.depth.clone()
    depth[:, 8:14, 8:14] -= 0.1  # a tower with walls at more than 85 degrees
    whole = mesh_of(scene.with_parameters(depth=depth), FOV_DEG)
    assert whole.trimmed == 0 and len(whole.faces) == 2 * (SIZE - 1) ** 2
    depth[:, :8, 8:14] -= 0.1  # now they reach the rim: the tower stands apart
    cut = mesh_of(scene.with_parameters(depth=depth), FOV_DEG)
    assert cut.trimmed > 0.1 and np.ptp(cut.vertices[:, 2]) < 0.04


def test_bad_meshes():
    scene = nosed()
    jagged = scene.with_parameters(depth=1 + 0.2 * (torch.arange(SIZE) % 2).expand(1, SIZE, SIZE))
    with pytest.raises(ValueError, match="nothing of this surface is seen at less than 85 degrees"):
        mesh_of(jagged, FOV_DEG)
    with pytest.raises(ValueError, match="unknown format 'glbb'; did you mean 'glb'"):
        mesh_of(scene, FOV_DEG).files("a", "glbb")
