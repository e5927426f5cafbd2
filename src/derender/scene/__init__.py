"""Scene parameters: the values that an image is decomposed into."""

from derender.scene.scene import Scene

__all__ = ["Scene"]
