"""Scene parameters: what a picture is taken apart into."""

from derender.scene.scene import Scene

__all__ = ["Scene"]
