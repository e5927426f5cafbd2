"""`lambert`: ambient plus directional light on a matt surface, no cast shadows (unsup3d, CVPR 2020)."""

from derender.renderers.renderer import Renderer


def lambert() -> Renderer:
    """Albedo times ambient + diffuse * max(0, n.l); has no settings."""
    return Renderer("lambert")
