"""Scene to image. This is the only door: everything else in this folder is how.

``rasterize`` (coordinates and depth without colours) is reached as ``derender.render.rasterize.rasterize``.
"""

from derender.render.backends import available_backends, chosen_backend
from derender.render.renderer import Rendering, render, render_scene, shade, warp

__all__ = ["Rendering", "available_backends", "chosen_backend", "render", "render_scene", "shade", "warp"]
