"""What the mirror image of a picture shows: the same scene with left and right exchanged."""

import torch

from derender.scene.scene import Scene

_LIGHT_SIGNS = (1.0, 1.0, 1.0, -1.0)  # ambient, diffuse, pitch, yaw
_CAMERA_SIGNS = (1.0, -1.0, -1.0, -1.0, 1.0, 1.0)  # rotation about x, y, z; translation along x, y, z


def seen_in_mirror(scene: Scene) -> Scene:
    """Scenes whose pictures are the mirror images (left to right) of these scenes' pictures.

    Raises:
        ValueError: there are further factors, of which nobody says what a mirror does to them.
    """
    if scene.extra:
        raise ValueError(f"what a mirror does to {', '.join(scene.extra)} is not known")
    return Scene(
        scene.depth.flip(-1),
        scene.albedo.flip(-1),
        scene.light * torch.tensor(_LIGHT_SIGNS).to(scene.light),
        scene.camera * torch.tensor(_CAMERA_SIGNS).to(scene.camera),
    )
