"""What a page asks for, made: pictures taken apart, shown in another light and view, as maps, mesh, archive.

Takes questions and gives bytes and plain values; knows no HTTP. Factors of several pictures are joined at the
model's size and enlarged afterwards (scene/enlarge.py). Not safe for several threads at once: the server
gives it one. Leaves out the pictures' own detail as texture.
"""

import base64
import io
import json
import zipfile
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from derender import __version__
from derender.data import as_float
from derender.evaluation.out_of_distribution import OUTLIER_PERCENTILE, percentile_of
from derender.features import FeatureTable, named
from derender.features.neighbours import nearest, same_picture
from derender.model import Derenderer
from derender.report import colours
from derender.report.mesh import model_mesh
from derender.report.panel import labelled_grid, strip
from derender.report.viewer.questions import Camera, Light, NeighbourQuestion, Question
from derender.report.viewer.refused import Refused
from derender.report.viewer.shelf import Shelf, TakenApart
from derender.scene import Scene
from derender.scene.crop_search import SEARCH_SCALE, as_bytes, best_crops
from derender.scene.enlarge import at_size
from derender.scene.light import lambert_shading
from derender.scene.normals import normals_from_depth
from derender.training.held_out_errors import HeldOutErrors, masked_l1, reconstruction_errors


def reading_size(model: Derenderer, framed: bool) -> int:
    """Side at which pictures are read, in pixels: larger where the best part of each is looked for."""
    return model.image_size * (SEARCH_SCALE if framed else 1)


@dataclass
class Studio:
    """A model and the pictures opened with it.

    Attributes:
        model: in evaluation mode.
        name: what the page calls the model.
        shelf: where opened pictures are kept.
        held_out: reconstruction errors that were stored with the model; None if there are none.
        table: features to look for neighbours in; None for none.
        fit_steps: of each scene to its picture (``model.fit_scenes``); 0 shows what encoders say.
        framed: whether of a picture larger than the model's the part is taken that it renders again best.
    """

    model: Derenderer
    name: str
    shelf: Shelf = field(default_factory=Shelf)
    held_out: HeldOutErrors | None = None
    table: FeatureTable | None = None
    fit_steps: int = 0
    framed: bool = False

    @property
    def reading_size(self) -> int:
        """Side of the pictures that ``open`` should be given."""
        return reading_size(self.model, self.framed)

    def open(self, picture: UInt8[np.ndarray, "3 s s"]) -> dict[str, Any]:
        """Take a picture apart and keep it; gives its name, its light and camera, how well it is rebuilt."""
        side = 1.0
        if self.framed and picture.shape[-1] != self.model.image_size:
            larger = torch.from_numpy(picture[None])
            (framing,) = best_crops(self.model, larger)
            side = framing.side
            picture = as_bytes(framing.cut(larger, self.model.image_size))[0].numpy()
        with torch.inference_mode():
            images = as_float(picture[None]).to(self.model.device)
            activations = self.model.activations(images)
            errors = reconstruction_errors(self.model, picture[None])
            if self.fit_steps:
                scene = self.model.fit_scenes(images, self.fit_steps).scene
                shown = masked_l1(self.model.render(scene), images)
            else:
                scene, shown = self.model.decode(self.model.codes(activations)), errors
        scene, l1 = scene.to("cpu"), float(shown[0])
        rows = {
            name: code[0].float().cpu().numpy()
            for name, code in self.model.features_from(activations).items()
        }
        name = self.shelf.put(TakenApart(picture, scene, rows, l1))
        percentile = None if self.held_out is None else float(percentile_of(errors, self.held_out)[0])
        return {
            "picture": name,
            "light": Light.of(scene.light[0]).model_dump(),
            "camera": Camera.of(scene.camera[0]).model_dump(),
            "l1": l1 if isfinite(l1) else None,
            "l1_as_read": float(errors[0]) if self.fit_steps and isfinite(errors[0]) else None,
            "percentile": percentile,
            "side": side,
            "odd": percentile is not None and percentile > OUTLIER_PERCENTILE,
        }

    def scene(self, question: Question) -> Scene:
        """The scene that is asked for, at its size."""
        scene = self.shelf.get(question.picture).scene
        for factor, other in question.swaps.items():
            parameter = {"geometry": "depth", "albedo": "albedo"}[factor]
            scene = scene.with_parameters(**{parameter: getattr(self.shelf.get(other).scene, parameter)})
        if question.light is not None:
            scene = scene.with_parameters(light=question.light.light_row())
        if question.camera is not None:
            scene = scene.with_parameters(camera=question.camera.camera_row())
        size = self.model.image_size if question.size is None else question.size
        return at_size(scene, max(size, self.model.image_size))

    def view(self, question: Question) -> bytes:
        """The rendering and, right of it, the shading, as one PNG; transparent where nothing is seen."""
        with torch.inference_mode():
            scene = self.scene(question)
            images = (self._rendered(scene), self._shading(scene))
        return _png(strip(list(images)), quick=True)

    def picture(self, question: Question) -> bytes:
        """The rendering alone, as a PNG with transparency."""
        with torch.inference_mode():
            return _png(self._rendered(self.scene(question)))

    def maps(self, question: Question) -> dict[str, Image.Image]:
        """Input, its reconstruction, what is asked for, and the factors of that, by name."""
        found = self.shelf.get(question.picture)
        with torch.inference_mode():
            scene = self.scene(question)
            own = at_size(found.scene, scene.depth.shape[-1])
            normal = normals_from_depth(scene.depth, self.model.fov_deg)
            return {
                "input": colours.pictures(found.picture[None])[0],
                "reconstruction": self._rendered(own),
                "view": self._rendered(scene),
                "depth": colours.depth_maps(scene.depth)[0],
                "normals": colours.normal_maps(normal)[0],
                "albedo": colours.pictures(scene.albedo)[0],
                "shading": self._shading(scene),
            }

    def panel(self, question: Question) -> bytes:
        """All maps with their names in one PNG."""
        return _png(_panel(self.maps(question)))

    def archive(self, question: Question) -> bytes:
        """A ZIP: the panel, every map, the mesh, and the settings."""
        maps = self.maps(question)
        files = {"panel.png": _png(_panel(maps))}
        files |= {f"{name}.png": _png(image) for name, image in maps.items()}
        files["surface.glb"] = self.mesh(question)
        files["settings.json"] = (json.dumps(self.settings(question), indent=1) + "\n").encode()
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return packed.getvalue()

    def mesh(self, question: Question) -> bytes:
        """The surface in its canonical view as GLB; ``Refused`` (422) where there is none."""
        scene = self.scene(question)
        try:
            made = model_mesh(self.model, scene)
        except ValueError as problem:
            raise Refused(422, str(problem)) from problem
        return made.files("surface")["surface.glb"]

    def settings(self, question: Question) -> dict[str, Any]:
        """Light and camera in numbers, and what made the picture."""
        scene = self.shelf.get(question.picture).scene
        light = question.light or Light.of(scene.light[0])
        camera = question.camera or Camera.of(scene.camera[0])
        return {
            "derender": __version__,
            "model": self.name,
            "light": light.model_dump(),
            "camera": camera.model_dump(),
            "from_another_picture": sorted(question.swaps),
            "size": max(question.size or 0, self.model.image_size),
        }

    def neighbours(self, question: NeighbourQuestion) -> list[tuple[int, float]]:
        """Rows nearest by one factor of the picture that gives it, and distances; not that picture itself."""
        if self.table is None:
            raise Refused(404, "there is no table to look in: start the viewer with --features FILE.parquet")
        other = dict(question.swaps).get(question.factor, question.picture)  # type: ignore[call-overload]
        codes = self.shelf.get(other).codes
        try:
            code = named(codes, question.factor, "factor")
            itself = same_picture(self.table, codes)
            found = nearest(self.table, code, question.factor, question.k, exclude=itself.tolist())
        except ValueError as problem:
            raise Refused(422, str(problem)) from problem
        return list(zip(found.rows[0].tolist(), found.distances[0].tolist(), strict=True))

    def _rendered(self, scene: Scene) -> Image.Image:
        rendering = self.model.render(scene.to(self.model.device))
        return colours.pictures(rendering.image, rendering.mask)[0]

    def _shading(self, scene: Scene) -> Image.Image:
        normal = normals_from_depth(scene.depth, self.model.fov_deg)
        return colours.shading_maps(lambert_shading(normal, scene.light))[0]


def data_url(image: Image.Image) -> str:
    """An image that travels inside JSON."""
    return "data:image/png;base64," + base64.b64encode(_png(image, quick=True)).decode()


def _panel(maps: dict[str, Image.Image]) -> Image.Image:
    return labelled_grid({name: [image] for name, image in maps.items()})


def _png(image: Image.Image, quick: bool = False) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format="PNG", compress_level=1 if quick else 6)
    return stream.getvalue()
