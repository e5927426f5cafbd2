"""Scene to image. This is the only door: everything else in this folder is how."""

from derender.render.rasterize import Fragments, available_backends, chosen_backend, rasterize
from derender.render.renderer import Rendering, render, render_scene, shade, warp

__all__ = [
    "Fragments",
    "Rendering",
    "available_backends",
    "chosen_backend",
    "rasterize",
    "render",
    "render_scene",
    "shade",
    "warp",
]
