"""Requests of the page, answered: images opened, shown under other light and view, as maps, mesh, archive.

Takes questions and gives bytes and plain values; knows no HTTP. Opened images stay in memory only, a bounded
number of them. Factors of several images are joined at the model's size; what is drawn has the photograph's
own detail, or is enlarged (scene/enlarge.py). Not safe for several threads at once: the server gives it one.
"""

import base64
import io
import json
import secrets
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
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
from derender.features.neighbours import nearest, same_image
from derender.model import Derenderer
from derender.photo import Frame, PhotoDetail, found_frame
from derender.report import colours
from derender.report.mesh import model_mesh
from derender.report.panel import labelled_grid, strip
from derender.report.viewer.questions import (
    LARGEST_SIZE,
    Camera,
    Light,
    NeighbourRequest,
    Refused,
    ViewRequest,
)
from derender.scene import Scene
from derender.scene.enlarge import at_size
from derender.scene.normals import normals_from_depth
from derender.training.held_out_errors import HeldOutErrors, masked_l1, reconstruction_errors

KEPT = 64
DETAILS_KEPT = 4
OFFERED_SIZES = (128, 256)


@dataclass(frozen=True)
class ShownImage:
    """One opened image.

    Attributes:
        pixels: at the model's size.
        photo: the same part of the photograph at up to ``LARGEST_SIZE``.
        scene: one scene, on the CPU.
        features: by factor, (D,) each.
    """

    pixels: UInt8[np.ndarray, "3 s s"]
    photo: UInt8[np.ndarray, "3 p p"]
    scene: Scene
    features: Mapping[str, np.ndarray]


class Shelf:
    """At most ``limit`` opened images by names that cannot be guessed; safe to use from several threads.

    When it is full, the image leaves that was not requested for longest.
    """

    def __init__(self, limit: int = KEPT):
        if limit < 2:
            raise ValueError(f"a shelf needs room for 2 images or more, for swaps; got {limit}")
        self.limit = limit
        self._images: OrderedDict[str, ShownImage] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._images)

    def put(self, image: ShownImage) -> str:
        """Store an image; returns its name."""
        name = secrets.token_urlsafe(16)
        with self._lock:
            self._images[name] = image
            while len(self._images) > self.limit:
                self._images.popitem(last=False)
        return name

    def get(self, name: str) -> ShownImage:
        """The image of that name, which now counts as used; ``Refused`` (410) if it has left."""
        with self._lock:
            if name not in self._images:
                raise Refused(
                    410, f"this image is no longer stored (the last {self.limit} are): open it again"
                )
            self._images.move_to_end(name)
            return self._images[name]


@dataclass
class Studio:
    """A model and the images opened with it.

    Attributes:
        model: in evaluation mode.
        name: of the model, on the page.
        shelf: the opened images.
        held_out: reconstruction errors that were stored with the model; None if there are none.
        table: features to look for neighbours in; None for none.
        fit_steps: of test-time optimisation of each scene; 0 shows feed-forward scenes.
        frame: how the part of an image is found that the model is given (``photo.found_frame``).
    """

    model: Derenderer
    name: str
    shelf: Shelf = field(default_factory=Shelf)
    held_out: HeldOutErrors | None = None
    table: FeatureTable | None = None
    fit_steps: int = 0
    frame: str | None = None
    _details: OrderedDict[tuple[str, int], PhotoDetail] = field(default_factory=OrderedDict)

    def about(self, largest_size: int) -> dict[str, Any]:
        """The model's name, sizes to draw at, ranges of the camera, and the number of images in memory."""
        own, ranges = self.model.image_size, self.model.settings.ranges
        return {
            "model": self.name,
            "sizes": sorted({own, *(size for size in (*OFFERED_SIZES, largest_size) if size > own)}),
            "fov_deg": self.model.fov_deg,
            "rotation_deg": ranges.rotation_deg,
            "translation": [ranges.translation_xy, ranges.translation_xy, max(ranges.translation_z, 0.1)],
            "kept": self.shelf.limit,
        }

    def open(
        self, photo: UInt8[np.ndarray, "h w 3"], pixels: UInt8[np.ndarray, "3 s s"] | None = None
    ) -> dict[str, Any]:
        """Decompose an image and store it; returns its name, light, camera and reconstruction error.

        ``pixels`` are what the model is given, where that is known already.

        The percentile is that of the feed-forward reconstruction.
        """
        try:
            way = self.frame if pixels is None else "none"
            frame, framed = found_frame(photo, self.model, way)
        except ValueError as problem:
            raise Refused(422, str(problem)) from problem
        if pixels is None:
            pixels = frame.cut(photo, self.model.image_size)
        shown = frame.cut(photo, min(max(round(frame.side), self.model.image_size), LARGEST_SIZE))
        with torch.inference_mode():
            images = as_float(pixels[None]).to(self.model.device)
            features = self.model.embed(images)
            errors = reconstruction_errors(self.model, pixels[None])
            if self.fit_steps:
                scene = self.model.fit_scenes(images, self.fit_steps).scene
                l1 = float(masked_l1(self.model.render(scene), images)[0])
            else:
                scene, l1 = self.model.decompose(images), float(errors[0])
        rows = {name: row[0].float().cpu().numpy() for name, row in features.items()}
        scene = scene.to("cpu")
        percentile = None if self.held_out is None else float(percentile_of(errors, self.held_out)[0])
        return {
            "picture": self.shelf.put(ShownImage(pixels, shown, scene, rows)),
            "light": Light.of(scene.light[0]).model_dump(),
            "camera": Camera.of(scene.camera[0]).model_dump(),
            "l1": l1 if isfinite(l1) else None,
            "l1_feed_forward": float(errors[0]) if self.fit_steps and isfinite(errors[0]) else None,
            "percentile": percentile,
            "side": frame.side / min(photo.shape[:2]),
            "framed": framed,
            "out_of_distribution": percentile is not None and percentile > OUTLIER_PERCENTILE,
        }

    def scene(self, question: ViewRequest) -> Scene:
        """The requested scene, at its size."""
        scene = self.shelf.get(question.picture).scene
        parameters = {factor.name: factor.parameter for factor in self.model.factors}
        for factor, other in question.swaps.items():
            parameter = parameters[factor]
            donor = self.shelf.get(other).scene
            scene = scene.with_parameters(**{parameter: donor.parameters[parameter]})
        if question.light is not None:
            scene = scene.with_parameters(light=question.light.light_row())
        if question.camera is not None:
            scene = scene.with_parameters(camera=question.camera.camera_row())
        return at_size(scene, max(question.size or 0, self.model.image_size))

    def view(self, question: ViewRequest) -> bytes:
        """The rendering and, right of it, the shading, as one PNG; transparent where nothing is seen."""
        with torch.inference_mode():
            scene = self.scene(question)
            return _png(strip([self._drawn(question, scene), self._shading(scene)]), quick=True)

    def picture(self, question: ViewRequest) -> bytes:
        """The rendering alone, as a PNG with transparency."""
        with torch.inference_mode():
            return _png(self._drawn(question, self.scene(question)))

    def maps(self, question: ViewRequest) -> dict[str, Image.Image]:
        """Input, its reconstruction, the requested view, and the factors of that, by name."""
        opened = self.shelf.get(question.picture)
        with torch.inference_mode():
            scene = self.scene(question)
            return {
                "input": colours.pictures(opened.pixels[None])[0],
                "reconstruction": self._rendered(at_size(opened.scene, scene.depth.shape[-1])),
                "view": self._drawn(question, scene),
                "depth": colours.depth_maps(scene.depth)[0],
                "normals": colours.normal_maps(normals_from_depth(scene.depth, self.model.fov_deg))[0],
                "albedo": colours.pictures(scene.albedo)[0],
                "shading": self._shading(scene),
                **{
                    title: colours.level_maps(draw(scene, self.model.fov_deg))[0]
                    for title, draw in self.model.renderer.maps.items()
                },
            }

    def panel(self, question: ViewRequest) -> bytes:
        """All maps with their names in one PNG."""
        return _panel(self.maps(question))

    def archive(self, question: ViewRequest) -> bytes:
        """A ZIP: the panel, every map, the mesh, and the settings."""
        maps = self.maps(question)
        files = {"panel.png": _panel(maps)} | {f"{name}.png": _png(image) for name, image in maps.items()}
        files["surface.glb"] = self.mesh(question)
        files["settings.json"] = (json.dumps(self.settings(question), indent=1) + "\n").encode()
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return packed.getvalue()

    def mesh(self, question: ViewRequest) -> bytes:
        """The surface in its canonical view as GLB; ``Refused`` (422) where there is none."""
        scene = self.scene(question)
        try:
            texture = None
            if question.detail == "photo":
                with torch.inference_mode():
                    name = dict(question.swaps).get("albedo", question.picture)
                    texture = self._detail(name, LARGEST_SIZE).albedo()
            return model_mesh(self.model, scene, texture=texture).files("surface")["surface.glb"]
        except ValueError as problem:
            raise Refused(422, str(problem)) from problem

    def settings(self, question: ViewRequest) -> dict[str, Any]:
        """Light and camera in numbers, and how the image was made."""
        scene = self.shelf.get(question.picture).scene
        return {
            "derender": __version__,
            "model": self.name,
            "light": (question.light or Light.of(scene.light[0])).model_dump(),
            "camera": (question.camera or Camera.of(scene.camera[0])).model_dump(),
            "from_another_picture": sorted(question.swaps),
            "size": max(question.size or 0, self.model.image_size),
        }

    def neighbours(self, question: NeighbourRequest) -> list[tuple[int, float]]:
        """Rows nearest by one factor of the image that gives it, and distances; without that image itself."""
        if self.table is None:
            raise Refused(404, "there is no table to look in: start the viewer with --features FILE.parquet")
        other = dict(question.swaps).get(question.factor, question.picture)  # type: ignore[call-overload]
        features = self.shelf.get(other).features
        try:
            feature = named(features, question.factor, "factor")
            itself = same_image(self.table, features)
            rows, away = nearest(self.table, feature, question.factor, question.k, exclude=itself.tolist())
        except ValueError as problem:
            raise Refused(422, str(problem)) from problem
        return list(zip(rows.tolist(), away.tolist(), strict=True))

    def _drawn(self, question: ViewRequest, scene: Scene) -> Image.Image:
        """A requested scene in the detail of the photograph that gives its colours, or of the model."""
        if question.detail == "model":
            return self._rendered(scene)
        size = scene.depth.shape[-1]
        detail = self._detail(dict(question.swaps).get("albedo", question.picture), size)
        return colours.pictures(detail(scene).image)[0]

    def _detail(self, name: str, size: int) -> PhotoDetail:
        """What draws an opened image; the last few are kept."""
        if (name, size) not in self._details:
            opened = self.shelf.get(name)
            side = opened.photo.shape[-1]
            photo = Frame.centred(side, side).cut(opened.photo.transpose(1, 2, 0), size)
            self._details[name, size] = PhotoDetail(
                as_float(photo[None])[0], opened.scene, self.model.fov_deg, renderer=self.model.renderer
            )
        self._details.move_to_end((name, size))
        while len(self._details) > DETAILS_KEPT:
            self._details.popitem(last=False)
        return self._details[name, size]

    def _rendered(self, scene: Scene) -> Image.Image:
        rendering = self.model.render(scene.to(self.model.device))
        return colours.pictures(rendering.image, rendering.mask)[0]

    def _shading(self, scene: Scene) -> Image.Image:
        return colours.shading_maps(self.model.renderer.shading(scene, self.model.fov_deg))[0]


def data_url(image: Image.Image) -> str:
    """An image that travels inside JSON."""
    return "data:image/png;base64," + base64.b64encode(_png(image, quick=True)).decode()


def _panel(maps: Mapping[str, Image.Image]) -> bytes:
    return _png(labelled_grid({name: [image] for name, image in maps.items()}))


def _png(image: Image.Image, quick: bool = False) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format="PNG", compress_level=1 if quick else 6)
    return stream.getvalue()
