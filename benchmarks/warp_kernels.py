"""Warp's kernels of benchmarks/peers.py; importing this imports warp."""

import warp as wp


@wp.kernel
def find(
    meshes: wp.array(dtype=wp.uint64),
    rays: wp.array(dtype=wp.vec3),
    of_map: wp.int32,
    face: wp.array(dtype=wp.int32),
):
    """The triangle that each pixel of each map shows, or -1."""
    pixel = wp.tid()
    met = wp.mesh_query_ray(meshes[pixel // of_map], wp.vec3(0.0, 0.0, 0.0), rays[pixel % of_map], 1.0e6)
    if met.result:
        face[pixel] = met.face
    else:
        face[pixel] = -1


@wp.kernel
def meet(
    points: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    rays: wp.array(dtype=wp.vec3),
    of_map: wp.int32,
    size: wp.int32,
    uv: wp.array(dtype=wp.vec2),
    depth: wp.array(dtype=wp.float32),
):
    """Canonical pixel coordinates and depth where the ray meets its triangle."""
    pixel = wp.tid()
    triangle = face[pixel]
    if triangle >= 0:
        first = (pixel // of_map) * of_map
        i = corners[3 * triangle]
        j = corners[3 * triangle + 1]
        k = corners[3 * triangle + 2]
        a = points[first + i]
        b = points[first + j]
        c = points[first + k]
        ray = rays[pixel % of_map]
        wa = wp.dot(ray, wp.cross(b, c))
        wb = wp.dot(ray, wp.cross(c, a))
        wc = wp.dot(ray, wp.cross(a, b))
        total = wa + wb + wc
        u = (wa * float(i % size) + wb * float(j % size) + wc * float(k % size)) / total
        v = (wa * float(i // size) + wb * float(j // size) + wc * float(k // size)) / total
        uv[pixel] = wp.vec2(u, v)
        depth[pixel] = (wa * a[2] + wb * b[2] + wc * c[2]) / total
