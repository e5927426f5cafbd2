"""Other rasterisers on the same job: which point of a grid mesh each pixel shows, and the gradient of that.

Each peer is a class made for a size and a number of maps; ``run(vertices, cotangents)`` takes the vertices of
all maps, (N, H, W, 3), and the gradients of some loss for uv (N, H, W, 2) and depth (N, H, W), or None for
the forward pass alone. It gives uv, depth, which pixels were hit (N, H, W), and the vertices' gradient. Trees
of boxes are built anew in every call, as vertices are new in every training step. Nothing here is needed by
derender:

    pip install warp-lang embreex mitsuba
    pip install --no-deps deodr

Left out: PyTorch3D, for which there is no wheel (measured elsewhere at 5.5 s for the job that takes Warp 87
ms), and OpenGL renderers (nvdiffrast), which need a GPU.
"""

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from derender.render.rasterize import rasterize
from derender.render.rasterize.reference import intersect, triangle_corners

Cotangents = tuple[Tensor, Tensor] | None
Found = tuple[Tensor, Tensor, Tensor, Tensor | None]


class Peer(Protocol):
    def run(self, vertices: Tensor, cotangents: Cotangents) -> Found: ...


class Ours:
    """derender's own rasteriser, by backend."""

    def __init__(self, maps: int, size: int, focal: float, backend: str):
        self.focal, self.backend = focal, backend

    def run(self, vertices: Tensor, cotangents: Cotangents) -> Found:
        vertices = vertices.detach().requires_grad_(cotangents is not None)
        seen = rasterize(vertices, self.focal, self.backend)
        gradient = None
        if cotangents is not None:
            (gradient,) = torch.autograd.grad((seen.uv, seen.depth), vertices, cotangents)
        return seen.uv.detach(), seen.depth.detach(), seen.mask > 0, gradient


def rays_of(size: int, focal: float) -> np.ndarray:
    """Where each pixel looks, (size * size, 3), with z = 1: distances along it are depths."""
    across = (np.arange(size, dtype=np.float32) - (size - 1) / 2) / focal
    x, y = np.meshgrid(across, across)
    return np.stack((x, y, np.ones_like(x)), axis=-1).reshape(-1, 3).astype(np.float32)


class Embree:
    """Intel's Embree finds the triangles; torch's autograd differentiates where rays meet them."""

    def __init__(self, maps: int, size: int, focal: float):
        self.scene = importlib.import_module("embreex.rtcore_scene").EmbreeScene
        self.mesh = importlib.import_module("embreex.mesh_construction").TriangleMesh
        self.size, self.focal, self.rays = size, focal, rays_of(size, focal)
        self.corners = triangle_corners(size, size, torch.device("cpu")).numpy()

    def run(self, vertices: Tensor, cotangents: Cotangents) -> Found:
        vertices = vertices.detach().requires_grad_(cotangents is not None)
        triangle = []
        for points in vertices.detach().flatten(1, 2).numpy():
            scene = self.scene()
            self.mesh(scene, np.ascontiguousarray(points[self.corners], np.float32))
            triangle.append(scene.run(np.zeros_like(self.rays), self.rays))
        result = torch.from_numpy(np.stack(triangle)).long().view(-1, self.size, self.size)
        uv, depth = intersect(vertices, result, self.focal)
        gradient = None
        if cotangents is not None:
            (gradient,) = torch.autograd.grad((uv, depth), vertices, cotangents)
        return uv.detach(), depth.detach(), result >= 0, gradient


class Warp:
    """NVIDIA Warp: its tree of boxes, and a kernel that its tape differentiates."""

    def __init__(self, maps: int, size: int, focal: float):
        self.warp = importlib.import_module("warp")
        self.kernels = importlib.import_module("warp_kernels")
        self.warp.config.quiet = True
        self.maps, self.size = maps, size
        self.rays = self.warp.array(rays_of(size, focal), dtype=self.warp.vec3, device="cpu")
        corners = triangle_corners(size, size, torch.device("cpu")).numpy().astype(np.int32)
        self.corners = self.warp.array(corners.ravel(), dtype=self.warp.int32, device="cpu")

    def run(self, vertices: Tensor, cotangents: Cotangents) -> Found:
        wp, count = self.warp, self.maps * self.size**2
        points = vertices.detach().reshape(-1, 3).contiguous()
        each = [
            wp.Mesh(wp.from_torch(part.contiguous(), dtype=wp.vec3), self.corners)
            for part in points.view(self.maps, -1, 3)
        ]
        meshes = wp.array([mesh.id for mesh in each], dtype=wp.uint64, device="cpu")
        face = wp.empty(count, dtype=wp.int32, device="cpu")
        of_map = self.size**2
        wp.launch(self.kernels.find, count, [meshes, self.rays, of_map, face], device="cpu")
        carried = wp.from_torch(points, dtype=wp.vec3, requires_grad=True)
        uv = wp.zeros(count, dtype=wp.vec2, device="cpu", requires_grad=True)
        depth = wp.zeros(count, dtype=wp.float32, device="cpu", requires_grad=True)
        tape = wp.Tape()
        with tape:
            inputs = [carried, self.corners, face, self.rays, of_map, self.size, uv, depth]
            wp.launch(self.kernels.meet, count, inputs, device="cpu")
        gradient = None
        if cotangents is not None:
            wanted = {
                uv: wp.from_torch(cotangents[0].reshape(-1, 2).contiguous(), dtype=wp.vec2),
                depth: wp.from_torch(cotangents[1].reshape(-1).contiguous()),
            }
            tape.backward(grads=wanted)
            gradient = wp.to_torch(carried.grad).view(vertices.shape).clone()
        shape = (self.maps, self.size, self.size)
        hit = wp.to_torch(face).view(shape) >= 0
        return (
            wp.to_torch(uv).detach().view(*shape, 2),
            wp.to_torch(depth).detach().view(shape),
            hit,
            gradient,
        )


class Mitsuba:
    """Mitsuba 3 (llvm_ad_rgb): rays met and differentiated by Dr.Jit."""

    def __init__(self, maps: int, size: int, focal: float):
        if "DRJIT_LIBLLVM_PATH" not in os.environ:
            results = sorted(Path("/usr/lib").rglob("libLLVM-*.so*"))
            if results:
                os.environ["DRJIT_LIBLLVM_PATH"] = str(results[-1])
        self.dr, self.mi = importlib.import_module("drjit"), importlib.import_module("mitsuba")
        self.mi.set_variant("llvm_ad_rgb")
        self.size = size
        rays = rays_of(size, focal)
        self.rays = self.mi.Ray3f(self.mi.Point3f(0), self.mi.Vector3f(*(self.mi.Float(r) for r in rays.T)))
        corners = triangle_corners(size, size, torch.device("cpu")).numpy().astype(np.uint32)
        self.corners = [self.mi.UInt32(column) for column in corners.T]
        self.scenes = []
        for _ in range(maps):
            mesh = self.mi.Mesh("grid", size**2, len(corners))
            parameters = self.mi.traverse(mesh)
            parameters["faces"] = self.mi.UInt32(corners.ravel())
            parameters["vertex_positions"] = self.mi.Float(np.ones(3 * size**2, np.float32))
            parameters.update()
            scene = self.mi.load_dict({"type": "scene", "grid": mesh})
            self.scenes.append((scene, self.mi.traverse(scene)))
        names = [name for name in self.scenes[0][1].keys() if name.endswith("vertex_positions")]  # noqa: SIM118
        self.name = names[0]

    def run(self, vertices: Tensor, cotangents: Cotangents) -> Found:
        dr, mi = self.dr, self.mi
        results = []
        for number, (scene, parameters) in enumerate(self.scenes):
            points = mi.Float(vertices[number].detach().reshape(-1).numpy())
            if cotangents is not None:
                dr.enable_grad(points)
            parameters[self.name] = points
            parameters.update()
            met = scene.ray_intersect(self.rays)
            hit, b1, b2 = met.is_valid(), met.uv.x, met.uv.y
            corner = [dr.gather(mi.UInt32, column, met.prim_index, hit) for column in self.corners]
            weights = (1 - b1 - b2, b1, b2)
            u = sum(weight * mi.Float(one % self.size) for weight, one in zip(weights, corner, strict=True))
            v = sum(weight * mi.Float(one // self.size) for weight, one in zip(weights, corner, strict=True))
            depth = met.t
            gradient = None
            if cotangents is not None:
                wanted = [
                    mi.Float(one.reshape(-1).numpy())
                    for one in (*cotangents[0][number].unbind(-1), cotangents[1][number])
                ]
                products = (one * value for one, value in zip(wanted, (u, v, depth), strict=True))
                dr.backward(dr.sum(dr.select(hit, sum(products), 0)))
                gradient = np.array(dr.grad(points))
            shown = [np.array(dr.select(hit, dr.detach(value), 0)) for value in (u, v, depth)]
            results.append((*shown, np.array(hit), gradient))
        u, v, depth, hit, gradient = zip(*results, strict=True)
        shape = (len(self.scenes), self.size, self.size)
        as_maps = [torch.from_numpy(np.stack(one)).view(shape) for one in (u, v, depth, hit)]
        gradients = None
        if cotangents is not None:
            gradients = torch.from_numpy(np.stack(gradient)).view(vertices.shape)
        return torch.stack(as_maps[:2], dim=-1), as_maps[2], as_maps[3], gradients


class Deodr:
    """DEODR: colours interpolated on the screen; as (u/z, v/z, 1/z) they are right in perspective.

    It shows front faces only; antialiased edges are off.
    """

    def __init__(self, maps: int, size: int, focal: float):
        self.deodr = importlib.import_module("deodr.differentiable_renderer")
        self.size, self.focal = size, focal
        corners = triangle_corners(size, size, torch.device("cpu")).numpy().astype(np.uint32)
        across = torch.arange(size, dtype=torch.float64)
        self.grid = torch.stack(torch.meshgrid(across, across, indexing="xy"), dim=-1).reshape(-1, 2)
        none = np.zeros(len(corners), bool)
        self.fixed = {
            "faces": corners, "faces_uv": corners, "textured": none, "shaded": none,
            "uv": np.zeros((size**2, 2)), "shade": np.zeros(size**2), "texture": np.zeros((0, 0, 3)),
            "edgeflags": np.zeros((len(corners), 3), bool), "height": size, "width": size, "nb_colors": 3,
            "background_color": np.zeros(3), "clockwise": True, "backface_culling": True,
        }  # fmt: skip

    def run(self, vertices: Tensor, cotangents: Cotangents) -> Found:
        results = [
            self._map(one, None if cotangents is None else (cotangents[0][number], cotangents[1][number]))
            for number, one in enumerate(vertices.detach())
        ]
        uv, depth, hit, gradient = zip(*results, strict=True)
        gradients = None if cotangents is None else torch.stack(gradient).to(vertices.dtype)
        return torch.stack(uv), torch.stack(depth), torch.stack(hit), gradients

    def _map(self, vertices: Tensor, cotangents: Cotangents) -> Found:
        points = vertices.double().reshape(-1, 3).requires_grad_(cotangents is not None)
        inverse = 1 / points[:, 2:]
        place = points[:, :2] * inverse * self.focal + (self.size - 1) / 2
        colours = torch.cat((self.grid * inverse, inverse), dim=1)
        scene = self.deodr.Scene2D(
            ij=place.detach().numpy().copy(), colors=colours.detach().numpy().copy(),
            depths=points[:, 2].detach().numpy().copy(), **self.fixed,
        )  # fmt: skip
        image, buffer = np.zeros((self.size, self.size, 3)), np.zeros((self.size, self.size))
        self.deodr.renderScene(scene, 0.0, image, buffer)
        drawn = torch.from_numpy(image.copy()).requires_grad_(cotangents is not None)
        hit = drawn.detach()[..., 2] > 0
        depth = torch.where(hit, 1 / torch.where(hit, drawn[..., 2], 1), 0)
        uv = drawn[..., :2] * depth[..., None]
        gradient = None
        if cotangents is not None:
            (wanted,) = torch.autograd.grad((uv, depth), drawn, [one.double() for one in cotangents])
            self.deodr.renderSceneB(scene, 0.0, image, buffer, np.ascontiguousarray(wanted.numpy()))
            given = [torch.from_numpy(one) for one in (scene.ij_b, scene.colors_b)]
            (gradient,) = torch.autograd.grad((place, colours), points, given)
            gradient = gradient.view(vertices.shape)
        return uv.detach().float(), depth.detach().float(), hit, gradient


PEERS: dict[str, tuple[str, Callable[..., Any]]] = {
    "Embree + torch": ("embreex", Embree),
    "Warp": ("warp", Warp),
    "Mitsuba 3": ("mitsuba", Mitsuba),
    "DEODR": ("deodr", Deodr),
}
"""By name: the module it needs, and the class."""
