"""A decomposition as images and files: input, reconstruction, every factor, another light and another view.

Takes images and the ``Scene`` a model found in them; gives a ``Decomposition``, from which panels, pages and
files are made. On disk each image has a folder: panel.png and one PNG per column. ``scene.npz`` has all scene
parameters and normals as the renderer takes them, ``scene.json`` light and camera in words and degrees.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees, radians
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.data import as_float
from derender.model import Derenderer
from derender.report import colours
from derender.report.opening import OpenedImage
from derender.report.panel import labelled_grid
from derender.report.sweeps import drawn
from derender.scene import Scene
from derender.scene.enlarge import at_size
from derender.scene.normals import normals_from_depth

OTHER_AMBIENT_SHARE, OTHER_LIGHT_YAW_RAD, OTHER_LIGHT_PITCH_RAD = 0.3, radians(40), radians(10)
OTHER_VIEW_YAW_RAD = radians(35)
COLUMN_MEANING = {
    "input": "the image as the model takes it",
    "reconstruction": "the image rendered from its factors",
    "depth": "geometry in the frontal view: bright is near, dark is far; one scale for all images",
    "normals": "direction of the surface: red to the right, green upwards, blue towards the viewer",
    "albedo": "colour of the surface without lighting",
    "shading": "lighting on this surface: white is fully lit",
    "another light": "the same object lit from the other side",
    "another view": "the same object rotated to the other side",
}


@dataclass(frozen=True)
class Decomposition:
    """Images of N decomposed images, one list of N per column."""

    # column name to N images, in the order of a panel: those of ``COLUMN_MEANING``, then the renderer's own,
    # then further factors whose parameter is a map
    columns: Mapping[str, colours.Images]
    scene: Scene  # the N scenes, on the CPU
    model: Derenderer  # made and drew them

    def sheet(self) -> Image.Image:
        """One labelled panel with a row for every image."""
        return labelled_grid(self.columns)

    @property
    def row(self) -> dict[str, Image.Image]:
        """The first image's columns."""
        return {name: images[0] for name, images in self.columns.items()}

    def write(self, folder: Path, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write the first image's files; returns the content of its scene.json."""
        scene = self.scene[0]
        named = {
            row.name: dict(zip((one.name for one in row.numbers), values, strict=True))
            for row in self.model.factors
            if row.numbers
            for values in scene.parameters[row.parameter].tolist()
        }
        ambient, diffuse, pitch, yaw = scene.light[0].tolist()
        *rotation, x, y, z = scene.camera[0].tolist()
        light = {"ambient": ambient, "diffuse": diffuse, "pitch_deg": degrees(pitch), "yaw_deg": degrees(yaw)}
        camera = {"rotation_deg": [*map(degrees, rotation)], "translation": [x, y, z]}
        written = {**record, "light": light, "camera": camera, **named}
        labelled_grid({name: [image] for name, image in self.row.items()}).save(folder / "panel.png")
        for name, image in self.row.items():
            image.convert("RGBA").save(folder / f"{name.replace(' ', '_')}.png")
        text = json.dumps(written, indent=1, ensure_ascii=False)
        (folder / "scene.json").write_text(text, encoding="utf-8", errors="backslashreplace")
        values: dict[str, Any] = {name: value[0].numpy() for name, value in scene.parameters.items()}
        values["normal"] = normals_from_depth(scene.depth, self.model.fov_deg)[0].numpy()
        np.savez_compressed(folder / "scene.npz", **values)
        return written


def decomposition(
    model: Derenderer, images: Float[Tensor, "n 3 h w"], scene: Scene,
    depth_range: tuple[float, float] | None = None,
) -> Decomposition:  # fmt: skip
    """Draw the scenes of ``images`` (0..1), as the model's renderer does.

    ``depth_range`` is the nearest and farthest depth of the colour scale; by default that of these scenes.
    """
    scene = scene.detach()
    columns = {
        "input": colours.pictures(images),
        "reconstruction": drawn(scene, model.render),
        **factor_images(scene, model, depth_range),
        "another light": drawn(under_another_light(scene), model.render),
        "another view": drawn(from_another_view(scene), model.render),
    }
    columns |= {title: columns.pop(title) for title in model.renderer.maps}  # the renderer's own come last
    further = {name: maps for name, value in scene.extra.items() if (maps := colours.any_maps(value))}
    return Decomposition({**columns, **further}, scene.to("cpu"), model)


@torch.no_grad()
def factor_images(
    scene: Scene, model: Derenderer, depth_range: tuple[float, float] | None = None
) -> dict[str, colours.Images]:
    """Depth, normals, albedo and shading of scenes, then what the renderer itself shows, by column name."""
    renderer, fov_deg = model.renderer, model.fov_deg
    return {
        "depth": colours.depth_maps(scene.depth, limits=depth_range),
        "normals": colours.normal_maps(normals_from_depth(scene.depth, fov_deg)),
        "albedo": colours.pictures(scene.albedo),
        "shading": colours.shading_maps(renderer.shading(scene, fov_deg)),
        **{title: colours.level_maps(draw(scene, fov_deg)) for title, draw in renderer.maps.items()},
    }


def decompose_images(model: Derenderer, images: Float[Tensor, "n 3 h w"]) -> Decomposition:
    """Decompose images (0..1) and draw the result."""
    with torch.no_grad():
        scene = model.decompose(images)
    return decomposition(model, images, scene)


def decomposed(model: Derenderer, image: OpenedImage) -> Decomposition:
    """An opened image (``opening``) with its factors drawn; images opened together share the depth scale."""
    scene, detail = image.scene, image.detail
    if detail is not None:
        albedo = detail.on_grid(detail.albedo(), detail.size)
        scene = at_size(scene, detail.size).with_parameters(albedo=albedo)
    return decomposition(model, as_float(image.pixels[None]), scene, image.depth_range)


def under_another_light(scene: Scene) -> Scene:
    """The scenes under a light as strong as their own, most of it from the opposite side."""
    strength = scene.light[:, 0] + scene.light[:, 1]
    ambient, pitch = OTHER_AMBIENT_SHARE * strength, torch.full_like(strength, OTHER_LIGHT_PITCH_RAD)
    yaw = OTHER_LIGHT_YAW_RAD * torch.where(scene.light[:, 3] > 0, -1.0, 1.0)
    return scene.with_parameters(light=torch.stack((ambient, strength - ambient, pitch, yaw), dim=1))


def from_another_view(scene: Scene) -> Scene:
    """The scenes rotated about the vertical axis, away from the side to which they look."""
    camera = scene.camera.clone()
    camera[:, 1] += OTHER_VIEW_YAW_RAD * torch.where(camera[:, 1] > 0, -1.0, 1.0)
    return scene.with_parameters(camera=camera)
