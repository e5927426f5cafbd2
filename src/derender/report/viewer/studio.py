"""Requests of the page, answered: images opened, shown under other light and view, as maps, mesh, archive.

Takes questions and gives bytes and plain values; knows no HTTP. A question without an answer is a ValueError.
Opened images stay in memory only, a bounded number of them. Factors of several images are joined at the
model's size. Drawn is a photograph with the crop changed in its own detail, or the model's rendering. Not
safe for several threads at once: the server gives it one.
"""

import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from math import ceil, isfinite
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from derender import __version__
from derender.data import as_float
from derender.features import named
from derender.features.extract import factor_codes
from derender.features.neighbours import nearest, same_image
from derender.model import Derenderer
from derender.photo import Frame, PhotoDetail, Photograph, find_faces, found_frame
from derender.photo.edit import MARGIN
from derender.photo.faces import frame_of, template_of
from derender.photo.frame import resized
from derender.postprocess.fitting import STEPS
from derender.report import colours
from derender.report.colours import image_bytes
from derender.report.decomposition import factor_images
from derender.report.mesh import model_mesh
from derender.report.panel import labelled_grid
from derender.report.sweeps import FILMS, circling_light, drawn, swapped, swaying_view
from derender.report.viewer import questions
from derender.report.viewer.images import Example, Gallery, Shelf, ShownImage, data_url
from derender.report.viewer.questions import Camera, Light, Refused, ViewRequest
from derender.scene import Scene
from derender.scene.enlarge import at_size
from derender.training import held_out_errors
from derender.training.held_out_errors import OUTLIER_PERCENTILE, HeldOutErrors, percentile_of

PHOTOGRAPHS_KEPT = 6  # ready to be drawn
LARGEST_PHOTO = 4096
PREVIEW_SIZE, SURFACE_SIZE = 1024, 128
FILM_SIZE, FILM_FRAMES, FILM_SECONDS = 384, 24, 3.0
FILM_LIGHT_DEG, FILM_VIEW_DEG = 50.0, 20.0


@dataclass
class Studio:
    """A model and the images opened with it."""

    model: Derenderer  # in evaluation mode
    name: str  # of the model, on the page
    shelf: Shelf = field(default_factory=Shelf)  # the opened images
    examples: Sequence[Example] = ()  # images to begin with
    gallery: Gallery | None = None  # rows to look for neighbours in; None for none
    # reconstruction errors that were stored with the model; None if there are none
    held_out: HeldOutErrors | None = None
    fit_steps: int = 0  # of test-time optimisation of each scene; 0 shows feed-forward scenes
    # how the part of an image is found that the model is given (``photo.found_frame``)
    frame: str | None = None

    def __post_init__(self) -> None:
        self._kept_photograph = lru_cache(PHOTOGRAPHS_KEPT)(self._photograph)

    def about(self) -> dict[str, Any]:
        """The model's name and abilities, ranges of the camera, examples, table, bound of the shelf."""
        ranges, rows, table = self.model.settings.ranges, self.model.factors, None
        reaches = (ranges.translation_xy, ranges.translation_xy, max(ranges.translation_z, 0.4))
        if self.gallery is not None:
            factors = [name for name in self.gallery.table.factors if name in self.model.nets]
            note = self.gallery.without_pictures
            table = {"rows": len(self.gallery.table), "factors": factors, "note": note}
        return {
            "examples": [{"name": one.name, "image": data_url(one.thumbnail())} for one in self.examples],
            "table": table,
            "model": self.name,
            "faces": template_of(self.model) is not None,
            "can_fit": self.model.fitting is not None,
            "fits": self.fit_steps > 0,
            "fov_deg": self.model.fov_deg,
            "light": any(row.parameter == "light" for row in rows),
            "numbers": {row.name: [asdict(one) for one in row.numbers] for row in rows if row.numbers},
            "maps": list(self.model.renderer.maps),
            "rotation_deg": ranges.rotation_deg,
            "translation": [min(reach, questions.FARTHEST) for reach in reaches],
            "kept": self.shelf.limit,
        }

    def open(
        self, photo: UInt8[np.ndarray, "h w 3"], pixels: UInt8[np.ndarray, "3 s s"] | None = None
    ) -> dict[str, Any]:
        """Decompose an image and store it; returns its name, crop, light, camera and reconstruction error.

        ``pixels`` are what the model is given, where that is known already. The percentile is that of the
        feed-forward reconstruction.
        """
        if max(photo.shape[:2]) > LARGEST_PHOTO:
            photo = resized(photo, LARGEST_PHOTO)
        template, faces = template_of(self.model), ()
        if pixels is None and template is not None and min(photo.shape[:2]) > self.model.image_size:
            faces = tuple(frame_of(face, template).snapped() for face in find_faces(photo))
        frame, framed = self._found(photo, faces, self.frame if pixels is None else "none")
        return self._decomposed(photo, faces, frame, framed, self.fit_steps, pixels)

    def again(self, question: questions.CropRequest) -> dict[str, Any]:
        """An opened image decomposed again: another crop, or its scene optimised; returns as `open` does."""
        opened, crop = self.shelf.get(question.picture), question.crop
        if question.fit and self.model.fitting is None:
            raise ValueError("fit: this model cannot optimise scenes per image; ask without it")
        frame, framed, (height, width) = opened.frame, opened.framed, opened.photo.shape[:2]
        if isinstance(crop, questions.Place):
            side = min(crop.side, 2.0 * max(height, width))
            frame = Frame(min(crop.x, width), min(crop.y, height), side, crop.roll_deg).snapped()
            framed = "own"
        elif crop is not None:
            frame, framed = self._found(opened.photo, opened.faces, crop)
        steps = (self.fit_steps or STEPS) if question.fit else 0
        return self._decomposed(opened.photo, opened.faces, frame, framed, steps)

    def _found(self, photo: np.ndarray, faces: Sequence[Frame], way: str | None) -> tuple[Frame, str]:
        """The part of a photograph that the model is given; its faces are known already."""
        looked_for = template_of(self.model) is not None and min(photo.shape[:2]) > self.model.image_size
        if faces and way in (None, "face"):
            return faces[0], "face"
        result = found_frame(photo, self.model, "none" if looked_for and way is None else way)
        return result.frame, "no face" if looked_for and way is None else result.how

    def _decomposed(
        self, photo: np.ndarray, faces: tuple[Frame, ...], frame: Frame, framed: str, fit_steps: int,
        pixels: np.ndarray | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        if pixels is None:
            pixels = frame.cut(photo, self.model.image_size)
        with torch.inference_mode():
            images = as_float(pixels[None]).to(self.model.device)
            features = {name: rows[0] for name, rows in factor_codes(self.model, images).items()}
            errors = held_out_errors.reconstruction_errors(self.model, pixels[None])
            if fit_steps:
                scene = self.model.fit_scenes(images, fit_steps).scene
                l1 = float(held_out_errors.masked_l1(self.model.render(scene), images)[0])
            else:
                scene, l1 = self.model.decompose(images), float(errors[0])
        scene = scene.to("cpu")
        percentile = None if self.held_out is None else float(percentile_of(errors, self.held_out)[0])
        opened = ShownImage(photo, faces, frame, framed, pixels, scene, features)
        return {
            "picture": self.shelf.put(opened),
            "light": Light.of(scene.light[0]).model_dump(),
            "camera": Camera.of(scene.camera[0]).model_dump(),
            "numbers": self._numbers(scene),
            "l1": l1 if isfinite(l1) else None,
            "l1_feed_forward": float(errors[0]) if fit_steps and isfinite(errors[0]) else None,
            "percentile": percentile,
            "width": photo.shape[1],
            "height": photo.shape[0],
            "crop": asdict(frame),
            "faces": [asdict(face) for face in faces],
            "framed": framed,
            "out_of_distribution": percentile is not None and percentile > OUTLIER_PERCENTILE,
        }

    def scene(self, question: ViewRequest) -> Scene:
        """The requested scene, at the model's size."""
        scene = self.shelf.get(question.picture).scene
        parameters = {factor.name: factor.parameter for factor in self.model.factors}
        for factor, other in question.swaps.items():
            scene = swapped(scene, self.shelf.get(other).scene, parameters[factor])
        if question.light is not None:
            scene = scene.with_parameters(light=question.light.light_row())
        if question.camera is not None:
            scene = scene.with_parameters(camera=question.camera.camera_row())
        for factor, values in question.numbers.items():
            if factor not in (own := self._numbers(scene)):
                raise ValueError(f"numbers: this model has no {factor!r}; it has {', '.join(own)}")
            scene = scene.with_parameters(**{parameters[factor]: torch.tensor([values])})
        self.model.renderer.check(scene)
        return scene

    def _numbers(self, scene: Scene) -> dict[str, list[float]]:
        return {f.name: scene.parameters[f.parameter][0].tolist() for f in self.model.factors if f.numbers}

    def view(self, question: ViewRequest) -> bytes:
        """The requested view: JPEG, or PNG with transparency where the model's pixels are drawn."""
        return _encoded(self._drawn(question))

    def before(self, question: ViewRequest) -> bytes:
        """The part of the photograph that `view` changes, as it was."""
        opened, size = self.shelf.get(question.picture), self._size(question)
        if question.detail == "model":
            return _encoded(Image.fromarray(opened.frame.cut(opened.photo, size).transpose(1, 2, 0)))
        return _encoded(Image.fromarray(self._shown(question).pixels))

    def preview(self, question: ViewRequest) -> bytes:
        """The whole photograph, small enough for the page."""
        photo = self.shelf.get(question.picture).photo
        return _encoded(Image.fromarray(resized(photo, min(PREVIEW_SIZE, max(photo.shape[:2])))))

    def picture(self, question: ViewRequest) -> bytes:
        """The whole photograph, edited, at its own size as PNG; or what the model renders."""
        if question.detail == "photo":
            side = max(self.shelf.get(_source(question)).photo.shape[:2])
            question = question.model_copy(update={"whole": True, "size": side})
        return image_bytes(self._drawn(question))

    def film(self, question: questions.FilmRequest) -> bytes:
        """GIF or MP4: the light circles, or the view goes from side to side."""
        question = question.model_copy(update={"size": min(self._size(question), FILM_SIZE)})
        moves = {"light": (circling_light, FILM_LIGHT_DEG), "camera": (swaying_view, FILM_VIEW_DEG)}
        move, reach_deg = moves[question.move]
        scenes = move(self.scene(question), FILM_FRAMES, reach_deg)
        frames = [self._drawn(question, scenes[number]) for number in range(len(scenes))]
        return FILMS[question.kind](frames, FILM_SECONDS)

    def maps(self, question: ViewRequest) -> dict[str, Image.Image]:
        """Input, its reconstruction, and the factors of the requested view, by name."""
        opened, size = self.shelf.get(question.picture), self._size(question)
        with torch.inference_mode():
            scene = at_size(self.scene(question), size)
            shown = {name: image for name, (image,) in factor_images(scene, self.model).items()}
            own = self._rendered(opened.scene, size)
            return {"input": colours.pictures(opened.pixels[None])[0], "reconstruction": own, **shown}

    def factors(self, question: ViewRequest) -> dict[str, str]:
        """The same as images inside JSON."""
        return {name: data_url(image) for name, image in self.maps(question).items()}

    def panel(self, question: ViewRequest) -> bytes:
        """All maps and the view with their names in one PNG."""
        columns = self.maps(question) | {"view": self._drawn(question)}
        return image_bytes(labelled_grid({name: [image] for name, image in columns.items()}))

    def archive(self, question: ViewRequest) -> bytes:
        """A ZIP: the panel, every map, the image, the mesh, and the settings."""
        files = {f"{name}.png": image_bytes(image) for name, image in self.maps(question).items()}
        files |= {"panel.png": self.panel(question), "view.png": self.picture(question)}
        files |= {"surface.glb": self.mesh(question), "settings.json": self.settings(question)}
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return packed.getvalue()

    def mesh(self, question: ViewRequest) -> bytes:
        """The surface in its canonical view as GLB, its texture of the requested size."""
        scene = at_size(self.scene(question), max(SURFACE_SIZE, self.model.image_size))
        texture = None
        if question.detail == "photo":
            opened = self.shelf.get(_source(question))
            pixels = as_float(opened.frame.cut(opened.photo, self._size(question))[None])[0]
            with torch.inference_mode():
                fov_deg, renderer = self.model.fov_deg, self.model.renderer
                texture = PhotoDetail(pixels, opened.scene, fov_deg, renderer=renderer).albedo()
        return model_mesh(self.model, scene, texture=texture).files("surface")["surface.glb"]

    def settings(self, question: ViewRequest) -> bytes:
        """Light and camera in numbers, and how the image was made: a file of JSON."""
        scene = self.scene(question)
        values = {
            "derender": __version__,
            "model": self.name,
            "light": (question.light or Light.of(scene.light[0])).model_dump(),
            "camera": (question.camera or Camera.of(scene.camera[0])).model_dump(),
            "numbers": self._numbers(scene),
            "from_another_picture": sorted(question.swaps),
            "size": self._size(question),
        }
        return (json.dumps(values, indent=1) + "\n").encode()

    def neighbours(self, question: questions.NeighbourRequest) -> list[tuple[int, float]]:
        """Rows nearest by one factor of the image that gives it, and distances; without that image itself."""
        table = self.searched().table
        other = dict(question.swaps).get(question.factor, question.picture)  # pyrefly: ignore[no-matching-overload]
        features = self.shelf.get(other).features
        feature, itself = named(features, question.factor, "factor"), same_image(table, features).tolist()
        rows, away = nearest(table, feature, question.factor, question.k, exclude=itself)
        return list(zip(rows.tolist(), away.tolist(), strict=True))

    def searched(self) -> Gallery:
        """The rows to look in; ``Refused`` (404) where there are none."""
        if self.gallery is None:
            raise Refused(404, "there is no table: start the viewer with --features FILE.parquet")
        return self.gallery

    def _size(self, question: ViewRequest) -> int:
        return max(question.size or 0, self.model.image_size)

    def _drawn(self, question: ViewRequest, scene: Scene | None = None) -> Image.Image:
        """A scene in the detail of the photograph that gives its colours, or of the model."""
        with torch.inference_mode():
            scene = self.scene(question) if scene is None else scene
            if question.detail == "model":
                return self._rendered(scene, self._size(question))
            changed = {name: value for name, value in scene.parameters.items() if name != "albedo"}
            return Image.fromarray(self._shown(question).edited(**changed))

    def _shown(self, question: ViewRequest) -> Photograph:
        """The photograph that gives the colours, or its part around the crop; the last few are kept."""
        return self._kept_photograph(_source(question), self._size(question), question.whole)

    def _photograph(self, name: str, size: int, whole: bool) -> Photograph:
        opened = self.shelf.get(name)
        frame, (height, width) = opened.frame, opened.photo.shape[:2]
        left, top, right, bottom = 0, 0, width, height
        if not whole:
            across, down = zip(*frame.widened(MARGIN).corners(), strict=True)
            left, right = max(0, int(min(across))), min(width, ceil(max(across)))
            top, bottom = max(0, int(min(down))), min(height, ceil(max(down)))
        scale = size / max(right - left, bottom - top)
        pixels = resized(opened.photo[top:bottom, left:right], size)
        place = Frame((frame.x - left) * scale, (frame.y - top) * scale, frame.side * scale, frame.roll_deg)
        return Photograph.of(pixels, place, opened.scene, self.model)

    def _rendered(self, scene: Scene, size: int) -> Image.Image:
        return drawn(at_size(scene, size).to(self.model.device), self.model.render)[0]


def _source(question: ViewRequest) -> str:
    """The image that gives the colours."""
    return dict(question.swaps).get("albedo", question.picture)


def _encoded(image: Image.Image) -> bytes:
    """As fast as a page needs it: JPEG, or PNG where there is transparency."""
    if image.mode != "RGB":
        return image_bytes(image, compress_level=1)
    return image_bytes(image, "JPEG", quality=92)
