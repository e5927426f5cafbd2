"""The value that generators return: pictures with the factors and maps that made them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8
from numpy import ndarray

from derender.scene.camera import rotation_matrix
from derender.scene.light import light_direction


@dataclass(frozen=True)
class SyntheticSet:
    """N square pictures of size S with exact truth, one sample at each pixel's centre.

    Attributes:
        images: shaded pictures over a background.
        depth: z in camera space, 0 on the background.
        normal: inward unit normals in the camera frame, 0 on the background.
        albedo: reflectance as seen by the camera, 0 on the background.
        mask: where the object is.
        parts: which part of the object is seen, a number into ``part_names``; 0 on the background.
        light: ambient, diffuse, pitch, yaw (radians, canonical frame).
        camera: rotation x, y, z (radians, about (0, 0, 1)), translation x, y, z.
        identity: number of the person or model.
        labels: what else is known of each picture, by column name (expression, age, ...): text or numbers.
        identity_traits: what was drawn for each picture's identity, by name.
        part_names: names of the parts, background first.
        fov_deg: field of view of every picture.
    """

    images: UInt8[ndarray, "n 3 s s"]
    depth: Float32[ndarray, "n s s"]
    normal: Float32[ndarray, "n s s 3"]
    albedo: UInt8[ndarray, "n 3 s s"]
    mask: Bool[ndarray, "n s s"]
    parts: UInt8[ndarray, "n s s"]
    light: Float32[ndarray, "n 4"]
    camera: Float32[ndarray, "n 6"]
    identity: Int64[ndarray, "n"]
    labels: Mapping[str, Shaped[ndarray, "n"]]
    identity_traits: Mapping[str, Shaped[ndarray, "n"]]
    part_names: tuple[str, ...]
    fov_deg: float = 10.0

    def __len__(self) -> int:
        return len(self.images)

    @property
    def expression(self) -> Shaped[ndarray, "n"]:
        """Name of each face's expression."""
        return self.labels["expression"]

    @property
    def strength(self) -> Shaped[ndarray, "n"]:
        """How strongly each expression shows."""
        return self.labels["strength"]


def camera_rotation_and_light(
    camera: Float32[ndarray, "n 6"], light: Float32[ndarray, "n 4"]
) -> tuple[Float64[ndarray, "n 3 3"], Float64[ndarray, "n 3"]]:
    """Rotation from canonical to camera frame, and the unit direction of light in the camera frame."""
    rotation = rotation_matrix(torch.from_numpy(camera[:, :3].astype(np.float64))).numpy()
    direction = light_direction(torch.from_numpy(light.astype(np.float64))).numpy()
    return rotation, np.einsum("nij,nj->ni", rotation, direction)
