"""One image under other lighting, from other viewpoints, or with a factor of another image.

``relit``, ``rotated`` and ``swapped_factors`` take an opened image (``opening``) and return an ``Edit``:
stills, their numbers and the frames of a film. On disk an edit is strip.png (labelled), each still as a PNG
with transparency, film.gif and film.mp4. moved.json has the numbers of every still.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from math import ceil, degrees, log10
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from derender.features import named
from derender.model import Derenderer
from derender.photo import Photograph
from derender.photo.video import Edit as VideoEdit
from derender.report import sweeps
from derender.report.colours import Images, pictures
from derender.report.opening import OpenedImage
from derender.report.options import EDIT_SIZE, FilmOptions
from derender.report.panel import GridLayout, labelled_grid
from derender.report.sweeps import FILMS
from derender.scene import Scene
from derender.scene.enlarge import at_size

SMALLEST_CELL, LARGEST_CELL = 128, 512
FILM_SIZE = 512  # largest side of a film of a whole photograph, in pixels


@dataclass(frozen=True)
class Edit:
    """One edited image."""

    inputs: Mapping[str, Image.Image]  # what it was made from, by label; these come first in the strip
    stills: Mapping[str, Image.Image]  # what came out, by label
    numbers: Mapping[str, Any]  # what holds in each still, by the same labels: anything JSON can hold
    frames: Images = field(default_factory=list)  # of a film; empty for none
    film: FilmOptions = field(default_factory=FilmOptions)  # its kinds, and how long it takes

    @property
    def row(self) -> dict[str, Image.Image]:
        """All images by label, in the order of the strip."""
        return {**self.inputs, **self.stills}

    def write(self, folder: Path, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write all files; returns the content of moved.json: the record, and each still's numbers."""
        cell = min(LARGEST_CELL, max(SMALLEST_CELL, *(still.width for still in self.stills.values())))
        strip = labelled_grid({name: [one] for name, one in self.row.items()}, layout=GridLayout(cell))
        stills = []
        with ThreadPoolExecutor() as pool:  # films are encoded while stills are
            kinds = self.film.kinds if self.frames else ()
            films = {kind: pool.submit(FILMS[kind], self.frames, self.film.seconds) for kind in kinds}
            strip.save(folder / "strip.png", compress_level=1)
            for number, (label, still) in enumerate(self.stills.items(), 1):
                name = f"still-{number:02d}.png"
                still.save(folder / name, compress_level=1)
                stills.append({"file": name, "label": label, **self.numbers[label]})
            for kind, film in films.items():
                (folder / f"film.{kind}").write_bytes(film.result())
        written = {**record, "stills": stills}
        text = json.dumps(written, indent=1, ensure_ascii=False)
        (folder / "moved.json").write_text(text, encoding="utf-8", errors="backslashreplace")
        return written


def relit(
    model: Derenderer, image: OpenedImage, *, reach_deg: float = 60.0, pitch_deg: float = 10.0,
    strength: float = 1.0, like: OpenedImage | None = None, film: FilmOptions | None = None,
) -> Edit:  # fmt: skip
    """The image under other lighting: from right to left, or from its own to that of another image.

    Args:
        reach_deg, pitch_deg: how far to the sides, and how high, the light goes, in degrees.
        strength: of the light, in multiples of the image's own.
        like: an image whose lighting is approached instead.
    """
    parameter = "light" if like is None else next(iter(like.scene.lighting))

    def lights(t: Tensor) -> Tensor:
        if like is None:
            return _lights(image.scene, t, reach_deg, pitch_deg, strength)
        own, other = (one.scene.lighting[parameter] for one in (image, like))
        return torch.lerp(own, other, t.to(own)[:, None])

    return _swept(model, image, like, parameter, lights, reach_deg, film)


def rotated(
    model: Derenderer, image: OpenedImage, *, reach_deg: float = 40.0, pitch_deg: float = 0.0,
    film: FilmOptions | None = None,
) -> Edit:  # fmt: skip
    """The image rotated from one side to the other, ``reach_deg`` to each, in its own lighting.

    Drawn in its own pixels it keeps its place and roll in the image; the model's rendering has none.
    """

    def cameras(t: Tensor) -> Tensor:
        rows = sweeps.cameras_around(t, reach_deg, pitch_deg)
        if image.detail is not None:
            rows[:, 2:] = image.scene.camera[:, 2:].to(rows)
        return rows

    return _swept(model, image, None, "camera", cameras, reach_deg, film)


def swapped_factors(
    model: Derenderer, image: OpenedImage, donor: OpenedImage, factors: Sequence[str] = (),
) -> Edit:  # fmt: skip
    """The image with one factor of another, for each of ``factors`` by itself (default: every factor)."""
    parameters = swappable(model, factors)
    stills = {}
    for name, parameter in parameters.items():
        render = (donor if parameter == "albedo" else image).render  # of whom the surface's colours are
        stills[f"its {name}"] = sweeps.drawn(sweeps.swapped(image.scene, donor.scene, parameter), render)[0]
    numbers = {f"its {name}": {"factor": name, "from": str(donor.path)} for name in parameters}
    return Edit(_inputs(model, image, donor), stills, numbers)


def relit_video(
    scene: Scene, *, reach_deg: float, pitch_deg: float, strength: float, like: OpenedImage | None,
    hold: bool,
) -> dict[str, Tensor]:  # fmt: skip
    """A light that goes round while a video plays, or stands still; arguments as for ``relit``."""
    if like is not None:
        return {name: light.expand(len(scene), -1) for name, light in like.scene.lighting.items()}
    return {"light": _lights(scene, _over_time(scene, hold), reach_deg, pitch_deg, strength)}


def rotated_video(scene: Scene, *, reach_deg: float, pitch_deg: float, hold: bool) -> dict[str, Tensor]:
    """A turn to either side on top of what the object does, while a video plays."""
    turn = sweeps.cameras_around(_over_time(scene, hold), reach_deg, pitch_deg)
    return {"camera": scene.camera + turn.to(scene.camera)}


def swapped_video(parameters: Sequence[str], donor: OpenedImage) -> VideoEdit:
    """The donor's light, depth or camera in every frame; the surface's colours stay the video's."""
    if "albedo" in parameters:
        raise ValueError("the albedo of a video cannot be swapped: choose factors, such as --factor light")
    own = donor.scene.parameters
    return lambda scene: {name: own[name].expand(len(scene), *own[name].shape[1:]) for name in parameters}


def _lights(scene: Scene, t: Tensor, reach_deg: float, pitch_deg: float, strength: float) -> Tensor:
    """Lights around the object, ``strength`` times as strong as the mean of the scenes' own."""
    own = float(scene.light[:, :2].sum(dim=1).mean())
    return sweeps.lights_around(t, reach_deg, pitch_deg, strength * own)


def _over_time(scene: Scene, hold: bool) -> Tensor:
    """Places of a sweep for the frames of a video."""
    return torch.ones(len(scene)) if hold else sweeps.there_and_back(len(scene))


def swappable(model: Derenderer, factors: Sequence[str] = ()) -> dict[str, str]:
    """Factor to scene parameter; an unknown factor is an error that suggests another."""
    parameters = {row.name: row.parameter for row in model.factors}
    return {name: named(parameters, name, "factor") for name in factors or parameters}


def _swept(
    model: Derenderer, image: OpenedImage, other: OpenedImage | None, parameter: str,
    values: Callable[[Tensor], Tensor], reach_deg: float, film: FilmOptions | None,
) -> Edit:  # fmt: skip
    """Stills and film of one scene along a sweep of one parameter."""
    if not reach_deg:
        raise ValueError("reach must not be 0 degrees")
    film = film or FilmOptions()
    decimals = max(0, ceil(-log10(2 * abs(reach_deg) / (film.stills - 1))))  # which distinguish the stills

    def drawn(rows: Tensor, render: sweeps.Render) -> Images:
        return sweeps.drawn(sweeps.varied(image.scene, **{parameter: rows}), render)

    def label(place: float, row: Tensor) -> str:
        if other is not None:
            return f"{place:.0%} of its light"
        word, angle_rad = ("yaw", row[1]) if parameter == "camera" else ("light", row[3])
        angle = f"{degrees(angle_rad):+.{decimals}f}°"
        return f"{word} {re.sub(r'^[+-](?=[0.]*°)', '', angle)}"  # 0 has no sign

    places = torch.linspace(0, 1, film.stills)
    rows = values(places)
    labels = [label(place, row) for place, row in zip(places.tolist(), rows, strict=True)]
    render, way, moving = image.render, sweeps.there_and_back(film.frames), []
    if film.kinds:
        smaller = render.at_most(FILM_SIZE) if isinstance(render, Photograph) else render
        there = drawn(values(way[: len(way) // 2 + 1]), smaller)  # the way back shows the same
        moving = [there[min(number, len(way) - number)] for number in range(len(way))]
    stills = dict(zip(labels, drawn(rows, render), strict=True))
    numbers = {text: {parameter: row} for text, row in zip(labels, rows.tolist(), strict=True)}
    return Edit(_inputs(model, image, other), stills, numbers, moving, film)


def _inputs(model: Derenderer, image: OpenedImage, other: OpenedImage | None) -> dict[str, Image.Image]:
    height, width = image.shown.shape[-2:]
    side = max(image.scene.depth.shape[-1], width if width == height else EDIT_SIZE)
    scene = at_size(image.scene, side)
    shown = {"input": pictures(image.shown[None])[0], "reconstruction": sweeps.drawn(scene, model.render)[0]}
    return shown if other is None else {**shown, "the other": pictures(other.shown[None])[0]}
