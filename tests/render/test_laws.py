"""What any correct renderer does: known answers in closed form and laws, on every backend."""

import math

import pytest
import torch
from tests.render.devices import rasterize, render, render_scene, shade, warp
from tests.render.scenes import FOV_DEG, assert_empty_outside, camera, pixel_grid, rays, scene, smooth_depth
from tests.tolerances import assert_agrees
from torch import Tensor
from torch.autograd import gradcheck

from derender.render import Rendering, available_backends, unwarp
from derender.scene.camera import focal_px, rotation_matrix, to_camera, to_canonical, unproject
from derender.scene.scene import Scene

pytestmark = pytest.mark.parametrize("backend", available_backends())
CENTRE = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def look(depth: Tensor, view: Tensor, backend: str):
    """Fragments of canonical depth (1, H, W) from a camera, and the points seen, in the canonical frame."""
    vertices = to_camera(unproject(depth, FOV_DEG), view)
    fragments = rasterize(vertices, focal_px(depth.shape[2], FOV_DEG), backend)
    return fragments, to_canonical(unproject(fragments.depth, FOV_DEG), view)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (33, 48), (2, 2), (7, 3), (128, 128), (200, 256)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_identity_camera_renders_the_canonical_image(backend, height, width, dtype, generator):
    depth = 0.9 + 0.2 * torch.rand(2, height, width, generator=generator, dtype=dtype)
    _, albedo, light, _ = scene(2, height, width, generator, dtype)
    result = render(depth, albedo, light, torch.zeros(2, 6, dtype=dtype), FOV_DEG, backend)
    canonical = shade(depth, albedo, light, FOV_DEG, backend)
    assert (result.mask == 1).all()
    if dtype == torch.float32:  # rounded once, from float64: the very bits
        assert torch.equal(result.image, canonical)
        assert torch.equal(result.depth, depth)
    else:
        assert (result.image - canonical).abs().max() < 1e-12
        assert (result.depth - depth).abs().max() < 1e-12


@pytest.mark.parametrize(("height", "width"), [(24, 24), (13, 20)])
def test_rendering_then_unprojecting_returns_the_surface(backend, height, width, generator):
    depth = smooth_depth(1, height, width, generator, torch.float64)
    seen, points = look(depth, camera(rx=0.3, ry=-0.5, rz=0.2, tx=0.01, tz=0.05), backend)
    # where in the mesh the point claims to be: the cell, and the triangle on its side of the falling diagonal
    covered = seen.mask[0] > 0
    uv, points = seen.uv[0][covered], points[0][covered]
    column, row = uv[:, 0].floor().long().clamp(0, width - 2), uv[:, 1].floor().long().clamp(0, height - 2)
    across, down = uv[:, :1] - column[:, None], uv[:, 1:] - row[:, None]
    mesh = unproject(depth, FOV_DEG)[0]
    a, b, c, d = mesh[row, column], mesh[row, column + 1], mesh[row + 1, column], mesh[row + 1, column + 1]
    upper = a + across * (b - a) + down * (c - a)
    lower = d + (1 - across) * (c - d) + (1 - down) * (b - d)
    assert covered.float().mean() > 0.4
    assert_agrees(points, torch.where(across + down <= 1, upper, lower))


def test_unwarping_undoes_the_camera_wherever_the_surface_is_seen(backend, generator):
    depth = smooth_depth(3, 40, 48, generator, torch.float64) * 0.3 + 0.7
    slopes = pixel_grid(40, 48) @ torch.rand(2, 3, generator=generator, dtype=torch.float64)
    painted = (slopes / slopes.amax()).movedim(-1, 0).expand(3, -1, -1, -1)
    for view in (camera(), camera(rx=0.1, ry=-0.2, rz=0.15, tx=0.004, ty=-0.006, tz=0.2)):
        view = view.expand(3, -1)
        shown = warp(painted, depth, view, FOV_DEG, backend)
        back = unwarp(torch.cat((shown.image, shown.mask[:, None]), dim=1), depth, view, FOV_DEG)
        whole = back[:, 3:].expand_as(painted) > 0.999
        assert whole.float().mean() > 0.8
        apart = (back[:, :3] - painted).abs() * whole
        assert apart[..., 3:-3, 3:-3].max() < 0.005  # half a pixel; at the rim zeros shine in


@pytest.mark.parametrize(
    "view", [{"ry": 0.8}, {"rx": -0.5, "ty": 0.01}, {"rx": 0.3, "ry": -0.4, "rz": 0.6, "tz": 0.1}]
)
@pytest.mark.parametrize(("height", "width"), [(16, 16), (9, 14)])
def test_plane_from_an_angle(backend, view, height, width):
    """The plane z = 1: depth, coordinates and coverage of every pixel in closed form."""
    pose = camera(**view)
    seen, _ = look(torch.ones(1, height, width, dtype=torch.float64), pose, backend)
    normal, through = rotation_matrix(pose[0, :3])[:, 2], CENTRE + pose[0, 3:]
    ray = rays(height, width)
    depth = (normal @ through) / (ray @ normal)
    point = to_canonical((depth[..., None] * ray)[None], pose)[0]
    uv = point[..., :2] * focal_px(width, FOV_DEG) + torch.tensor([width - 1, height - 1]) / 2
    inside = ((uv >= 0) & (uv <= torch.tensor([width - 1, height - 1]))).all(-1)
    assert 0.2 < inside.float().mean() < 1
    assert torch.equal(seen.mask[0] > 0, inside)
    assert_agrees(seen.depth[0], torch.where(inside, depth, 0))
    assert_agrees(seen.uv[0], torch.where(inside[..., None], uv, 0))


@pytest.mark.parametrize("yaw", [0.6, -0.6])
def test_step_from_an_angle_and_occlusion_takes_the_nearer_surface(backend, yaw):
    """A near left half, a far right half, the wall between: the middle row, intersected by hand."""
    size, near, far, last_left = 33, 0.95, 1.05, 15
    depth = torch.full((1, size, size), far, dtype=torch.float64)
    depth[..., : last_left + 1] = near
    pose = camera(ry=yaw)
    seen, _ = look(depth, pose, backend)
    ray_x = rays(size, size)[0, :, 0]
    pieces = [
        ((ray_x[0] * near, near), (ray_x[last_left] * near, near), 0, last_left),
        ((ray_x[last_left] * near, near), (ray_x[last_left + 1] * far, far), last_left, last_left + 1),
        ((ray_x[last_left + 1] * far, far), (ray_x[-1] * far, far), last_left + 1, size - 1),
    ]
    hits, coordinates = [], []
    for (x0, z0), (x1, z1), u0, u1 in pieces:
        ends = to_camera(torch.tensor([[[x0, 0, z0], [x1, 0, z1]]], dtype=torch.float64), pose)[0]
        (x0, _, z0), (x1, _, z1) = ends
        share = (ray_x * z0 - x0) / ((x1 - x0) - ray_x * (z1 - z0))
        hit = (share >= -1e-9) & (share <= 1 + 1e-9)
        hits.append(torch.where(hit, z0 + share * (z1 - z0), torch.inf))
        coordinates.append(u0 + share * (u1 - u0))
    nearest, piece = torch.stack(hits).min(0)
    layers = torch.stack(hits).isfinite().sum(0)
    middle = size // 2
    covered = seen.mask[0, middle] > 0
    assert torch.equal(covered, layers > 0)
    assert_agrees(seen.depth[0, middle], torch.where(covered, nearest, 0))
    u = torch.stack(coordinates).gather(0, piece[None])[0]
    assert_agrees(seen.uv[0, middle, :, 0], torch.where(covered, u, 0))
    # yaw > 0 moves the near half away from the far half and shows the wall; yaw < 0 pushes it in front
    hidden, wall = (layers >= 2) & covered, (piece == 1) & covered
    assert (wall if yaw > 0 else hidden).sum() >= 5


@pytest.mark.parametrize(
    ("view", "shift"),
    [({"ry": 0.3}, (-1, 0)), ({"rx": 0.3}, (0, 1)), ({"tx": 0.02}, (1, 0)), ({"ty": 0.02}, (0, 1))],
)
def test_signs_of_the_camera_in_the_image(backend, view, shift):
    """A bright spot at the tip of a bump moves left with yaw, down with pitch (the top comes forward)."""
    u, v = (pixel_grid(33, 33) - 16).unbind(-1)
    depth = (1.0 - 0.05 * (-(u**2 + v**2) / 50).exp())[None]
    spot = (-(u**2 + v**2) / 4).exp()[None, None]
    image = warp(spot, depth, camera(**view), FOV_DEG, backend).image[0, 0]
    moved = [float((image * axis).sum() / image.sum()) for axis in (u, v)]
    for distance, sign in zip(moved, shift, strict=True):
        assert distance * sign > 2 if sign else abs(distance) < 0.5
    above = (-(u**2 + (v + 10) ** 2) / 4).exp()[None, None]  # roll turns the image clockwise
    plane = torch.ones(1, 33, 33, dtype=torch.float64)
    image = warp(above, plane, camera(rz=math.pi / 2), FOV_DEG, backend).image[0, 0]
    moved = [float((image * axis).sum() / image.sum()) for axis in (u, v)]
    assert moved == pytest.approx([10, 0], abs=0.1)


def test_defaults_parts_and_scenes_are_the_same_rendering(backend, generator):
    """Ten degrees where no field of view is given; nothing is clipped at 1."""
    depth, albedo, light, pose = values = scene(2, 9, 7, generator)
    light[:, :2] = torch.tensor([0.9, 0.8])
    expected = render(*values, 10.0, backend)
    assert expected.image.max() > 1
    canonical = shade(depth, albedo, light, backend=backend)
    others = [render(*values, backend=backend), render_scene(Scene(*values), FOV_DEG, backend)]
    others += [render_scene(Scene(*values), backend=backend), warp(canonical, depth, pose, backend=backend)]
    for other in others:
        assert all(torch.equal(getattr(other, name), getattr(expected, name)) for name in vars(other))
    assert not torch.equal(render(*values, 11.0, backend).image, expected.image)
    assert not torch.equal(shade(depth, albedo, light, 11.0, backend), canonical)


def test_images_of_a_batch_do_not_mix(backend, generator):
    values = scene(5, 9, 7, generator)
    whole = render(*values, FOV_DEG, backend)
    for n in range(5):
        alone = render(*(value[n : n + 1] for value in values), FOV_DEG, backend)
        assert torch.equal(alone.image[0], whole.image[n])
        assert torch.equal(alone.depth[0], whole.depth[n])


def test_gradcheck_of_render(backend, generator):
    values = scene(1, 4, 5, generator, torch.float64, turn_rad=0.3)
    inputs = tuple(value.requires_grad_() for value in values)

    def outputs(*parts: Tensor) -> tuple[Tensor, Tensor]:
        result = render(*parts, 40.0, backend)
        return result.image, result.depth

    assert 0.3 < render(*values, 40.0, backend).mask.mean() < 1
    assert gradcheck(outputs, inputs)


def test_uncovered_pixels_are_empty_and_send_no_gradient(backend, generator):
    values = scene(3, 12, 15, generator, torch.float64)
    values[3][:, 3] += 0.05
    inputs = [value.requires_grad_() for value in values]
    result = render(*inputs, FOV_DEG, backend)
    assert_empty_outside(result)
    outside = 1 - result.mask
    assert 0.1 < outside.mean() < 0.9
    loss = (result.image * 1e30 * outside[:, None]).sum() + (result.depth * 1e30 * outside).sum()
    for gradient in torch.autograd.grad(loss, inputs):
        assert (gradient == 0).all()


AWAY = [{"ry": math.pi / 2}, {"rx": -math.pi / 2}, {"ry": math.pi / 2 - 1e-4}, {"ry": math.pi}, {"tz": -2.0}]
AWAY += [{"tz": -1.0}, {"tz": -0.999, "rx": 0.5}, {"tx": 1e6}, {"tz": 1e6}]
AWAY += [{"tx": math.inf}, {"ry": math.nan}]


@pytest.mark.parametrize("view", AWAY)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cameras_that_turn_the_surface_away_are_survived(backend, view, dtype, generator):
    depth, albedo, light, _ = scene(1, 9, 8, generator, dtype)
    image = shade(depth, albedo, light, FOV_DEG, backend).requires_grad_()
    vertices = to_camera(unproject(depth, FOV_DEG), camera(dtype, **view)).requires_grad_()
    seen = rasterize(vertices, focal_px(8, FOV_DEG), backend)
    assert_empty_outside(seen)
    (gradient,) = torch.autograd.grad(seen.uv.sum() + seen.depth.sum(), vertices)
    assert gradient.isfinite().all()
    result = warp(image, depth, camera(dtype, **view), FOV_DEG, backend)
    assert_empty_outside(result)
    (gradient,) = torch.autograd.grad(result.image.sum(), image)
    assert gradient.isfinite().all()
    if view == {"ry": math.pi}:
        assert result.mask.mean() > 0.5  # both faces are seen
    if view.get("tz", 0) in (-2.0, 1e6) or not math.isfinite(sum(view.values())):
        assert (result.mask == 0).all()


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf, -math.inf])
def test_a_vertex_gone_wrong_takes_only_its_own_triangles_along(backend, bad, generator):
    points = unproject(smooth_depth(1, 8, 8, generator), FOV_DEG)
    points[0, 3, 4] = bad
    points.requires_grad_()
    seen = rasterize(points, focal_px(8, FOV_DEG), backend)
    assert_empty_outside(seen)
    expected = torch.ones(8, 8)
    expected[3, 4] = 0  # the only pixel that touches no other triangle
    assert torch.equal(seen.mask[0], expected)
    (gradient,) = torch.autograd.grad(seen.uv.sum() + seen.depth.sum(), points)
    assert gradient.isfinite().all()


def test_a_mesh_without_area_shows_nothing(backend):
    points = torch.tensor([0.0, 0.0, 1.0]).expand(2, 6, 5, 3).clone().requires_grad_()
    seen = rasterize(points, 20.0, backend)
    assert (seen.mask == 0).all()
    assert_empty_outside(seen)
    (gradient,) = torch.autograd.grad(seen.uv.sum() + seen.depth.sum(), points)
    assert (gradient == 0).all()


@pytest.mark.parametrize(("beyond_px", "covered"), [(0.08, True), (0.12, False)])
@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_a_large_triangle_reaches_a_ten_thousandth_beyond_its_edge(backend, side, beyond_px, covered):
    """Two triangles some thousand pixels large, one edge just short of one of the image's four pixels."""
    short = torch.tensor([-1000.0, 1 - beyond_px], dtype=torch.float64)
    short = 1 - short.flip(0) if side in ("left", "top") else short
    other, focal = torch.tensor([-1000.0, 1000.0], dtype=torch.float64), 10.0
    u, v = (short, other) if side in ("left", "right") else (other, short)
    v, u = torch.meshgrid(v, u, indexing="ij")
    points = torch.stack(((u - 0.5) / focal, (v - 0.5) / focal, torch.ones_like(u)), dim=-1)
    expected = torch.ones(2, 2, dtype=torch.float64)
    line = 0 if side in ("left", "top") else 1
    expected.select(1 if side in ("left", "right") else 0, line).fill_(float(covered))
    assert torch.equal(rasterize(points[None], focal, backend).mask[0], expected)


def test_folded_mesh_takes_the_first_triangle_within_the_tie_tolerance(backend):
    """Three layers of a strip that folds back and forth, each a little nearer than the one before."""
    focal, columns = 10.0, torch.tensor([0.8, 3.2, 0.8, 3.2, 0.8], dtype=torch.float64)

    def layer_of(depth_of_column: list[float]) -> float:
        z = torch.tensor(depth_of_column, dtype=torch.float64)
        x, y = (columns - 2) / focal * z, (torch.tensor([-0.9, 0.9]) / focal)[:, None] * z
        strip = torch.stack((x.expand(2, 5), y, z.expand(2, 5)), dim=-1)
        outside = strip[-1:] + torch.tensor([0.0, 9.0, 0.0])  # more rows, out of sight
        return float(rasterize(torch.cat((strip, outside))[None], focal, backend).uv[0, 1, 2, 0])

    # inverse depth at the pixel, halfway along each layer, relative to the first layer, in millionths
    assert 0 < layer_of([1.0, 1.0, 1.0, 1.0, 1.0]) < 1
    assert 0 < layer_of([1.0, 1.0, 1 - 0.8e-6, 1.0, 1.0]) < 1  # 0.4: a tie, the first wins
    assert 1 < layer_of([1.0, 1.0, 1 - 4e-6, 1.0, 1.0]) < 3  # 2: nearer
    # 0, 0.8, 1.6: the first is out of reach of the third, the second is not, and comes first
    assert 1 < layer_of([1.0, 1.0, 1 - 1.6e-6, 1 - 1.6e-6, 1.0]) < 2


def test_half_precision_and_autocast_leave_geometry_in_float32(backend, generator):
    values = scene(2, 16, 16, generator)
    expected = render(*values, FOV_DEG, backend)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = render(*values, FOV_DEG, backend)
    assert torch.equal(result.image, expected.image)
    halves = [value.bfloat16() for value in values]
    coarse = render(*halves, FOV_DEG, backend)
    assert coarse.image.dtype == torch.float32
    assert torch.equal(coarse.image, render(*(value.float() for value in halves), FOV_DEG, backend).image)


def test_an_empty_batch_gives_an_empty_batch(backend):
    result = render(*map(torch.ones, ((0, 6, 5), (0, 3, 6, 5), (0, 4), (0, 6))), FOV_DEG, backend)
    assert isinstance(result, Rendering)
    assert result.image.shape == (0, 3, 6, 5)
