"""A photograph in, a photograph out: relit or turned, in its own detail and at its own size; or its scene.

The part that suits the model is found: a face, or the middle. It is decomposed, drawn under another light or
from another side by ``PhotoDetail``, and put back into the photograph. Results have the kind of what was
given: a Pillow image for a path or a Pillow image, an array for an array, a tensor for a tensor.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.data import GivenImages, as_photos
from derender.inputs import as_model
from derender.model import Derenderer
from derender.photo.detail import PhotoDetail, smooth
from derender.photo.faces import PROFILE_DEG, UTKFACE, face_candidates, frame_of, template_of
from derender.photo.frame import Frame, Pixels, resized
from derender.render import Rendering
from derender.scene import Scene
from derender.scene.crop import SEARCH_SCALE, best_crop
from derender.storage.places import require_known

AMBIENT_SHARE = 0.35  # of a light's strength; the rest is diffuse
FIT_STEPS = 10  # that optimise a scene before edits, if the model can; with more, new light fits heads less
LARGEST_CROP = 1024  # side of the largest crop drawn pixel by pixel; of larger ones the change is enlarged
BEYOND_SHARE, BLUR_SHARE = 0.03, 0.08  # from so far outside a photograph on its border is blurred; its reach
MARGIN = 0.35  # how far edits reach beyond the frame, in shares of its side
FRAMES = ("face", "auto", "none")  # ways to find the part of a photograph that a model is given


@dataclass(frozen=True)
class Photograph:
    """A decomposed photograph; called like a renderer, it draws scenes into the whole of it.

    Attributes:
        pixels: all of it.
        frame: the part that the model was given.
        surroundings: the larger part that edits change.
        scene: what it found there, one scene.
        detail: draws scenes in the photograph's own detail.
    """

    pixels: Pixels
    frame: Frame
    surroundings: Frame
    scene: Scene
    detail: PhotoDetail

    @classmethod
    def of(cls, pixels: Pixels, frame: Frame, scene: Scene, model: Derenderer | PhotoDetail) -> "Photograph":
        """A photograph with the one scene that a model found in a part of it; its ``renderer`` shades."""
        wide = frame.widened(MARGIN)
        size = min(max(scene.depth.shape[-1], round(wide.side)), LARGEST_CROP)
        photo = torch.from_numpy(wide.cut(pixels, size)).to(scene.depth.device).float() / 255
        with torch.inference_mode():
            margin = (wide.side / frame.side - 1) / 2
            width, height = pixels.shape[1], pixels.shape[0]
            beyond = wide.beyond(width, height, size).to(photo)[None, None]
            if bool(beyond.any()):  # what the border cuts off would leave a streak
                border = smooth(photo[None], (beyond > 0).to(photo), BLUR_SHARE * size)
                photo = torch.lerp(photo, border[0], (beyond[0] / BEYOND_SHARE).clamp(max=1))
            visible = wide.visible(width, height, size)
            detail = PhotoDetail(photo, scene, model.fov_deg, margin, model.renderer, visible)
        return cls(pixels, frame, wide, scene, detail)

    def at_most(self, side: int) -> "Photograph":
        """The same with its longer side at most so many pixels."""
        if (share := side / max(self.pixels.shape[:2])) >= 1:
            return self
        x, y, across = (share * value for value in (self.frame.x, self.frame.y, self.frame.side))
        frame = Frame(x, y, across, self.frame.roll_deg)
        return Photograph.of(resized(self.pixels, side), frame, self.scene, self.detail)

    @torch.inference_mode()
    def __call__(self, scene: Scene) -> Rendering:
        """Whole photographs (N, 3, H, W) of scenes that differ from its own; the mask is 1, depth is 0."""
        drawn, own = self.detail(scene).image, self.scene
        moved = not torch.equal(scene.camera, own.camera.expand_as(scene.camera))
        moved |= not torch.equal(scene.depth, own.depth.expand_as(scene.depth))
        wholes = [self.surroundings.paste(self.pixels, self.detail.photo, one, moved) for one in drawn]
        images = torch.from_numpy(np.stack(wholes)).permute(0, 3, 1, 2).float() / 255
        return Rendering(images, torch.zeros_like(images[:, 0]), torch.ones_like(images[:, 0]))

    def edited(self, **parameters: Tensor) -> Pixels:
        """The whole photograph with another ``light`` (1, 4), ``camera`` (1, 6) or other vectors."""
        image = self(self.scene.with_parameters(**parameters)).image[0]
        return (255 * image).round().byte().permute(1, 2, 0).numpy()

    def relit(self, yaw_deg: float, pitch_deg: float = 10.0, strength: float = 1.0) -> Pixels:
        """The photograph under a light from there; arguments as in `relight`."""
        power = strength * float(self.scene.light[0, :2].sum())
        light = [AMBIENT_SHARE * power, (1 - AMBIENT_SHARE) * power, radians(pitch_deg), radians(yaw_deg)]
        return self.edited(light=self.scene.light.new_tensor([light]))

    def rotated(self, yaw_deg: float, pitch_deg: float = 0.0) -> Pixels:
        """The photograph with its object turned; arguments as in `rotate`."""
        camera = self.scene.camera.clone()
        camera[:, :2] += camera.new_tensor([radians(pitch_deg), radians(yaw_deg)])
        return self.edited(camera=camera)


def open_photograph(
    pixels: Pixels, model: Derenderer, *, frame: str | None = None, fit_steps: int | None = None
) -> Photograph:
    """Find the part that suits the model, and decompose it.

    ``frame`` is as `found_frame` takes it, ``fit_steps`` are as `editable_scenes` takes them. A photograph
    that does not suit the model is a warning.
    """
    place, small = _cut_out(pixels, model, frame)
    return Photograph.of(pixels, place, editable_scenes(model, small, fit_steps), model)


def _cut_out(pixels: Pixels, model: Derenderer, frame: str | None) -> tuple[Frame, Float[Tensor, "1 3 s s"]]:
    """The part of a photograph that suits the model, and its pixels at the model's size."""
    place, _, doubt = found_frame(pixels, model, frame)
    if doubt:
        warnings.warn(f"{doubt}; choose frame auto or none if that is meant", stacklevel=2)
    own = torch.from_numpy(place.cut(pixels, model.image_size)[None])
    return place, own.to(model.device).float() / 255


def editable_scenes(model: Derenderer, images: Float[Tensor, "n 3 h w"], steps: int | None = None) -> Scene:
    """Scenes of images before they are edited, optimised in ``editing_steps``."""
    steps = editing_steps(model, steps)
    return model.fit_scenes(images, steps).scene if steps else model.decompose(images)


def editing_steps(model: Derenderer, steps: int | None) -> int:
    """Steps as given; None are ``FIT_STEPS`` if the model can be optimised per image, else 0."""
    if steps is not None and steps < 0:
        raise ValueError(f"fit_steps must be 0 or more, got {steps}")
    return steps if steps is not None else FIT_STEPS if model.fitting is not None else 0


@torch.inference_mode()
def decompose(
    image: GivenImages, model: Derenderer | str | Path = "faces-64", *, frame: str | None = None,
    fit_steps: int = 0,
) -> Scene:  # fmt: skip
    """Geometry, albedo, light and camera of photographs of any size: one scene for each.

    Arguments are as in `relight`; ``fit_steps`` optimise the scenes. The maps have the model's size. No
    image is a ValueError.
    """
    loaded = as_model(model)
    if isinstance(image, (list, tuple)) and not image:
        raise ValueError("decompose needs at least one image, got none")
    parts = [_cut_out(photo, loaded, frame)[1] for photo in as_photos(image)]
    return editable_scenes(loaded, torch.cat(parts), fit_steps)


def relight(
    image: GivenImages, model: Derenderer | str | Path = "faces-64", *, yaw_deg: float = 50.0,
    pitch_deg: float = 10.0, strength: float = 1.0, like: GivenImages | None = None,
    frame: str | None = None, fit_steps: int | None = None,
) -> Any:  # fmt: skip
    """A photograph under another light.

    Args:
        image: a path, a Pillow image, an array or tensor (bytes, or numbers in 0..1), or several.
        model: a model, or the name of one.
        yaw_deg, pitch_deg: where the light comes from: left of the image and above are positive; below 90.
        strength: of the light, in multiples of the photograph's own; 0.35 of it is ambient.
        like: take all of the light of this image instead.
        frame, fit_steps: as in `open_photograph`.

    Returns:
        What was given, in kind and size; a list for a list.

    Raises:
        ValueError: no face is found, or the image has values outside 0..1.
    """
    loaded = as_model(model)
    check_angles(yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    if not 0 <= strength < float("inf"):
        raise ValueError(f"strength must be 0 or more, got {strength}")
    opened = partial(open_photograph, model=loaded, frame=frame, fit_steps=fit_steps)
    if like is None:
        return _each(image, lambda one: opened(one).relit(yaw_deg, pitch_deg, strength))
    lighting = opened(as_photos(like)[0]).scene.lighting
    return _each(image, lambda one: opened(one).edited(**lighting))


def rotate(
    image: GivenImages, model: Derenderer | str | Path = "faces-64", *, yaw_deg: float = 20.0,
    pitch_deg: float = 0.0, frame: str | None = None, fit_steps: int | None = None,
) -> Any:  # fmt: skip
    """A photograph whose object is turned from where it looks, in its own light.

    Args:
        image: a path, a Pillow image, an array or tensor (bytes, or numbers in 0..1), or several.
        model: a model, or the name of one.
        yaw_deg: positive turns it to the left of the image.
        pitch_deg: positive brings its top forward.
        frame, fit_steps: as in `open_photograph`.

    Returns:
        What was given, in kind and size; a list for a list.
    """
    loaded = as_model(model)
    check_angles(yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    opened = partial(open_photograph, model=loaded, frame=frame, fit_steps=fit_steps)
    return _each(image, lambda one: opened(one).rotated(yaw_deg, pitch_deg))


class FoundFrame(NamedTuple):
    """The part of a photograph that a model is given, and how it was found."""

    frame: Frame
    how: str  # "face", "profile", "auto", "none", or "no face": the middle square
    doubt: str = ""  # the measured reason why it does not suit the model


def found_frame(pixels: Pixels, model: Derenderer, frame: str | None = None) -> FoundFrame:
    """The part of a photograph that suits a model.

    ``frame`` is "face", the largest face (an error where none is found); "auto", the square part that the
    model reconstructs best; "none", the middle square. None: the largest face if the model is known to be of
    faces and one is found, else the middle square ("no face"). Images no larger than the model's give the
    middle square.
    """
    if frame is not None:
        require_known("frame", frame, FRAMES)
    middle = Frame.centred(pixels.shape[1], pixels.shape[0])
    if frame == "auto":
        squares = _squares(middle, pixels.shape[1], pixels.shape[0])
        cuts = np.stack([square.cut(pixels, SEARCH_SCALE * model.image_size) for square in squares])
        at, crop = best_crop(model, torch.from_numpy(cuts))
        return FoundFrame(squares[at].part(crop.across, crop.down, crop.side).snapped(), "auto")
    template = template_of(model)
    if frame == "none" or (frame is None and (template is None or middle.side <= model.image_size)):
        return FoundFrame(middle, "none")
    candidates = face_candidates(pixels)
    face = next((candidate for candidate in candidates if not candidate.rejected), None)
    if face is not None:
        place, turned = frame_of(face, template or UTKFACE).snapped(), abs(face.yaw_deg)
        if turned <= PROFILE_DEG:
            return FoundFrame(place, "face")
        doubt = f"the face is turned by {turned:.0f} degrees, models of faces know {PROFILE_DEG:.0f}"
        return FoundFrame(place, "profile", doubt)
    how, doubt = "no face", "no face is found"
    if candidates:
        surest = max(candidates, key=lambda candidate: candidate.confidence)
        if (turned := abs(surest.yaw_deg)) > PROFILE_DEG:
            how, doubt = "profile", f"{doubt}, perhaps a profile turned by {turned:.0f} degrees"
        doubt += f" (surest candidate: {surest.rejected})"
    if frame is None:
        return FoundFrame(middle, how, doubt)
    raise ValueError(f"{doubt}: choose frame auto or none")


def _squares(middle: Frame, width: int, height: int) -> list[Frame]:
    """The middle square, then those of its side along a photograph's longer side, overlapping by half."""
    steps = max(1, round(2 * (max(width, height) / middle.side - 1))) if width != height else 0
    places = np.linspace(middle.side / 2, max(width, height) - middle.side / 2, steps + 1)
    along = "x" if width > height else "y"
    return [middle, *(replace(middle, **{along: float(place)}) for place in places if steps)]


def check_angles(**angles_deg: float) -> None:
    """Raise ValueError where an angle of a light or a view is no less than a right one."""
    for name, deg in angles_deg.items():
        if not -90 < deg < 90:
            raise ValueError(f"{name} must lie between -90 and 90 degrees, got {deg:g}: give a smaller angle")


def _each(image: GivenImages, edit: Callable[[np.ndarray], np.ndarray]) -> Any:
    """Edit every image, and return them in the kind they were given in."""
    if isinstance(image, (list, tuple)):
        return [_each(one, edit) for one in image]
    edited = np.stack([edit(photo) for photo in as_photos(image)])
    if not isinstance(image, Tensor | np.ndarray):
        return Image.fromarray(edited[0])
    if image.ndim == 2:
        edited = edited.mean(axis=-1).round().astype(np.uint8)
    elif image.shape[-1] != 3:
        edited = edited.transpose(0, 3, 1, 2)
    edited = edited if image.ndim == 4 else edited[0]
    edited = edited if image.dtype in (np.uint8, torch.uint8) else edited / 255
    return torch.from_numpy(edited).to(image) if isinstance(image, Tensor) else edited.astype(image.dtype)
