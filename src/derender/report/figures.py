"""A decomposition as images: input, reconstruction, every factor, another light and another view.

Takes pictures and the ``Scene`` a model found in them; gives a ``Decomposition``, from which panels,
pages and single files are made. Leaves out training a model and writing files.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import radians

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.render import Rendering
from derender.report import colours
from derender.report.panel import GridLayout, labelled_grid
from derender.scene import Scene
from derender.scene.light import lambert_shading
from derender.scene.normals import normals_from_depth

OTHER_LIGHT = {"ambient_share": 0.3, "yaw_rad": radians(40), "pitch_rad": radians(10)}
OTHER_VIEW_TURN_RAD = radians(35)
COLUMN_MEANING = {
    "input": "the picture the model was given",
    "reconstruction": "the picture rendered again from the four factors below",
    "depth": "geometry in the frontal view: bright is near, dark is far; one scale for all pictures",
    "normals": "direction of the surface: red to the right, green upwards, blue towards the viewer",
    "albedo": "colour of the surface with light taken away",
    "shading": "what the light adds on this surface: white is fully lit",
    "another light": "the same object lit from the other side",
    "another view": "the same object turned the other way",
}


@dataclass(frozen=True)
class Decomposition:
    """Images of N pictures taken apart, one list of N per column.

    Attributes:
        columns: column name to N images, in the order of a panel; names as in ``COLUMN_MEANING``.
        light: (N, 4) ambient, diffuse, pitch, yaw (radians).
        camera: (N, 6) rotation x, y, z (radians), translation x, y, z.
        depth_range: the nearest and farthest depth of the colour scale, one for all N pictures.
    """

    columns: Mapping[str, colours.Images]
    light: Float[Tensor, "n 4"]
    camera: Float[Tensor, "n 6"]
    depth_range: tuple[float, float]

    def __len__(self) -> int:
        return len(self.light)

    def panel(self, index: int, layout: GridLayout | None = None) -> Image.Image:
        """The labelled panel of one picture."""
        return labelled_grid({name: [images[index]] for name, images in self.columns.items()}, layout=layout)

    def sheet(self, row_labels: list[str] | None = None, layout: GridLayout | None = None) -> Image.Image:
        """One labelled panel with a row for every picture."""
        return labelled_grid(self.columns, row_labels, layout=layout)


def decomposition(
    pictures: Float[Tensor, "n 3 h w"],
    scene: Scene,
    render: Callable[[Scene], Rendering],
    fov_deg: float,
    colour_map: str = "magma",
) -> Decomposition:
    """Draw what was found in ``pictures`` (0..1); ``render`` is ``model.render`` or the plain renderer."""
    scene = scene.detach()
    with torch.no_grad():
        again, relit, turned = (
            render(scene),
            render(under_another_light(scene)),
            render(from_another_view(scene)),
        )
        normal = normals_from_depth(scene.depth, fov_deg)
        shading = lambert_shading(normal, scene.light)
    limits = colours.depth_range(scene.depth)
    columns = {
        "input": colours.pictures(pictures),
        "reconstruction": colours.pictures(again.image, again.mask),
        "depth": colours.depth_maps(scene.depth, limits=limits, colour_map=colour_map),
        "normals": colours.normal_maps(normal),
        "albedo": colours.pictures(scene.albedo),
        "shading": colours.shading_maps(shading),
        "another light": colours.pictures(relit.image, relit.mask),
        "another view": colours.pictures(turned.image, turned.mask),
    }
    return Decomposition(columns, scene.light.cpu(), scene.camera.cpu(), limits)


def under_another_light(scene: Scene) -> Scene:
    """The scenes with a light as strong as their own, most of it from the opposite side."""
    light = scene.light
    side = torch.where(light[:, 3] > 0, -1.0, 1.0)
    other = torch.empty_like(light)
    strength = light[:, 0] + light[:, 1]
    other[:, 0] = OTHER_LIGHT["ambient_share"] * strength
    other[:, 1] = strength - other[:, 0]
    other[:, 2] = OTHER_LIGHT["pitch_rad"]
    other[:, 3] = OTHER_LIGHT["yaw_rad"] * side
    return scene.with_parameters(light=other)


def from_another_view(scene: Scene) -> Scene:
    """The scenes turned about the vertical axis, away from the side to which they look."""
    camera = scene.camera.clone()
    side = torch.where(camera[:, 1] > 0, -1.0, 1.0)
    camera[:, 1] += side * OTHER_VIEW_TURN_RAD
    return scene.with_parameters(camera=camera)
