"""Trials: images, their task, training rows, and test rows at growing angles of light or camera.

Every curve names rows of one stack of images, so that features are computed once for all of it. Turning the
camera leaves the light where it is, turning the light leaves ambient and diffuse. Angles are degrees; 0 is
the front. Leaves out every score. There are three sources of images.

Generated: light and view were set, all else depends on seed and index alone. Each image is shown from both
sides. For identity other images of the same people are tested, for any other label other people.

Rendered: real images are decomposed and re-rendered by a model, training images each in its own light and
view. Angles are the model's own, and its features have an advantage: read it beside generated images.

True: the unit is the track where there are tracks, else the image. Of every class, the less rotated half of
its units is ordinary: three of four learn, the fourth is tested as the curve's first point. The other half is
tested in portions, by growing angle.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64, UInt8

from derender.data import ImageSet
from derender.data.synthetic import KINDS, SyntheticSet
from derender.evaluation.linear_task import Task, task_of
from derender.evaluation.options import Options
from derender.features import chosen, map_batches, missing, model_fingerprint, named
from derender.scene import Scene
from derender.training.step import fill_uncovered

LEVELS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
LABELS = {"faces": "identity", "cars": "class"}  # the question by kind of generated images
_OBJECTS = {"faces": "identity", "cars": "model"}  # as the settings of their generators call them


@dataclass(frozen=True)
class Axis:
    """One way to turn light or camera.

    ``part`` is that of a generator's settings, "view" or "light"; ``settings`` has, by kind of generated
    image, the name of the angle's range there. ``column`` is that of a scene's camera or light. ``truth`` are
    the labels (radians) of the angle; two mean a light's direction. The column ``cleared`` of a scene and the
    setting ``held`` of generated images are set to 0.
    """

    name: str
    title: str
    part: str
    settings: Mapping[str, str]
    column: int
    truth: tuple[str, ...]
    cleared: int | None = None
    held: str | None = None
    most_deg: float = 85.0

    def rotated(self, scene: Scene, angle_deg: float) -> Scene:
        """The scenes at this angle instead of their own; sign as in docs/reference/conventions.md."""
        name = "camera" if self.part == "view" else "light"
        values = scene.parameters[name].clone()
        if self.cleared is not None:
            values[:, self.cleared] = 0
        values[:, self.column] = math.radians(angle_deg)
        return scene.with_parameters(**{name: values})

    def true_deg(self, labels: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) angles off the front by the labels, in degrees, 0 or more; without these labels an error."""
        if absent := [name for name in self.truth if name not in labels]:
            what = f"the true {self.title} is not among the labels (there is no {absent[0]!r})"
            raise ValueError(f"{what}: give rendered images with a params.csv, as derender synth writes them")
        angles = [np.asarray(labels[name], np.float64) for name in self.truth]
        if len(angles) == 1:
            return np.degrees(np.abs(angles[0]))
        return np.degrees(np.arctan(np.hypot(*(np.tan(angle) for angle in angles))))


_PITCH, _YAW = {"faces": "pitch_deg", "cars": "pitch_deg"}, {"faces": "yaw_deg", "cars": "yaw_deg"}
_HEIGHT, _DIRECTION = ("light_pitch_rad",), ("light_yaw_rad", "light_pitch_rad")
AXES: Mapping[str, Axis] = {  # by name of the option
    axis.name: axis
    for axis in (
        Axis("yaw", "camera yaw", "view", {**_YAW, "cars": "azimuth_deg"}, 1, ("camera_y_rad",)),
        Axis("pitch", "camera pitch", "view", {"faces": "pitch_deg"}, 0, ("camera_x_rad",), most_deg=60.0),
        Axis("light", "light from the side", "light", _YAW, 3, _DIRECTION, 2, "pitch_deg"),
        Axis("light-pitch", "light from above and below", "light", _PITCH, 2, _HEIGHT, 3, "yaw_deg"),
    )
}


def chosen_axes(names: Sequence[str], kind: str | None = None) -> tuple[Axis, ...]:
    """Axes by name; an unknown one, or one about which generated images cannot be rotated, is an error."""
    axes = tuple(AXES[name] for name in dict.fromkeys(chosen(names, AXES, "axis")))
    for axis in axes:
        if kind is not None and kind not in axis.settings:
            raise ValueError(f"generated {kind} cannot be rotated about the axis {axis.name!r}: leave it out")
    return axes


def checked_levels(levels: Sequence[float], axes: Sequence[Axis]) -> tuple[float, ...]:
    """Angles in degrees, checked against the largest of every axis."""
    most, result = min(axis.most_deg for axis in axes), tuple(map(float, levels))
    words = ", ".join(f"{level:g}" for level in result) or "none"
    if len(result) < 2 or any(b <= a for a, b in pairwise(result)):
        raise ValueError(f"angles must be two or more that grow, such as 0,30,60; got {words}")
    if result[0] < 0 or result[-1] > most:
        asked = ", ".join(axis.name for axis in axes)
        raise ValueError(f"angles must lie within 0..{most:g} degrees for {asked}, got {words}")
    return result


def all_angles(axes: Sequence[Axis], levels: Sequence[float]) -> list[tuple[Axis, float]]:
    """Every axis at every level to either side, 0 once, in the order of a trial's images."""
    return [(axis, angle) for axis in axes for level in levels for angle in sorted({level, -level})]


@dataclass(frozen=True)
class Curve:
    """Tests at growing ``levels`` (degrees), after learning from rows in ordinary light and view.

    ``points`` are the rows tested: first in that light and view, then at each level.
    """

    name: str
    title: str
    learn: Int64[np.ndarray, " n"]
    levels: tuple[float, ...]
    points: tuple[Int64[np.ndarray, " _"], ...]


@dataclass(frozen=True)
class Trial:
    """Images, for training and tests, the targets of these M rows, and a curve for each axis.

    Rows of one ``unit`` (the same face at several angles, the images of one person, a track) are resampled
    together. ``how`` is the source of other lights and views, in words; ``n_dropped`` rows carry no label.
    """

    images: UInt8[np.ndarray, "m 3 s s"]
    task: Task
    unit: Int64[np.ndarray, " m"]
    curves: tuple[Curve, ...]
    how: str
    n_dropped: int = 0

    def __post_init__(self) -> None:
        for curve in self.curves:
            sizes = [len(rows) for rows in curve.points]
            if len(curve.learn) < 5 or 0 in sizes:
                tested = ", ".join(map(str, sizes))
                have = f"{len(curve.learn)} rows to learn from and {tested} to be tested on"
                raise ValueError(f"{curve.title}: {have}: five and one are the least; give more images")
            both = np.intersect1d(self.unit[curve.learn], self.unit[np.concatenate(curve.points)])
            if len(both):
                raise ValueError(f"{curve.title}: {len(both)} units would be both learned from and tested")

    @property
    def pictures(self) -> ImageSet:
        """All images, to compute features of."""
        files = tuple(f"{row:06d}" for row in range(len(self.images)))
        return ImageSet(self.images, files, source=self.how)


def stacked(
    task: Task, unit: np.ndarray, n_learn: int, axes: Sequence[Axis], levels: tuple[float, ...]
) -> tuple[Task, np.ndarray, tuple[Curve, ...]]:
    """For a trial of ``n_learn`` training images, T test images, and these at ``all_angles``, in this order.

    Rows without a label are neither learned from nor tested.
    """
    test, asked = np.arange(n_learn, len(task)), all_angles(axes, levels)
    shown = np.concatenate((np.arange(len(task)), np.tile(test, len(asked))))
    sides = [len(test) * len({level, -level}) for _ in axes for level in levels]
    parts = np.split(np.arange(len(shown)), np.cumsum([n_learn, len(test), *sides])[:-1])
    known = task.known[shown]
    learn, ordinary, *tested = (rows[known[rows]] for rows in parts)
    curves = tuple(
        Curve(axis.name, axis.title, learn, levels, (ordinary, *tested[at : at + len(levels)]))
        for axis, at in zip(axes, range(0, len(tested), len(levels)), strict=True)
    )
    return task.select(shown), unit[shown].astype(np.int64), curves


@dataclass(frozen=True)
class Recipe:
    """Generated images of ``people`` faces or cars, ``learned`` and ``tested`` of each.

    ``label`` is the question: ``identity``, or a label of the generator, about as many other people. Numbers
    become "above" or "below" the median of the training images.
    """

    kind: str = "faces"
    label: str = "identity"
    people: int = 40
    learned: int = 8
    tested: int = 2
    image_size: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        if self.people < 2 or self.learned < 1 or self.tested < 1:
            need = "two people or more, each with an image to learn from and one to test"
            got = f"{self.people} people, {self.learned} and {self.tested} images"
            raise ValueError(f"generated images need {need}; got {got}")

    def generate(
        self, part: str, count: int | None = None, axis: Axis | None = None, angle: float = 0.0
    ) -> SyntheticSet:
        """Images of ``part`` "learned" or "tested", in usual light and view or at a fixed angle in degrees.

        Both parts count people so that numbers agree; indices of images never do, so no seed is shared.
        """
        (generate, settings), one, each = KINDS[self.kind], _OBJECTS[self.kind], getattr(self, part)
        start = -(-self.people * self.learned // self.tested)  # people before the first one tested
        fixed: dict[str, Any] = {f"pictures_per_{one}": each}
        if part == "learned":  # of another label than identity other people are tested
            fixed[f"first_{one}"] = start + (self.people if self.label != "identity" else 0)
        if axis is not None:
            ranges = {axis.settings[self.kind]: (angle, angle), axis.held: (0.0, 0.0)}
            usual = getattr(settings(), axis.part).model_dump()
            fixed[axis.part] = usual | {name: ends for name, ends in ranges.items() if name is not None}
        first = 0 if part == "learned" else start * self.tested
        number = self.people * each if count is None else count
        return generate(number, self.image_size, self.seed, settings(**fixed), first=first)


def generated_trial(recipe: Recipe, axes: Sequence[Axis], levels: tuple[float, ...], how: Options) -> Trial:
    """Generate the images, or find them in the cache."""
    sample = recipe.generate("tested", 1)
    named({"identity": sample.identity, **sample.labels}, recipe.label, f"label of generated {recipe.kind}")
    inputs = {
        "recipe": {name: getattr(recipe, name) for name in ("kind", "people", "learned", "tested", "seed")},
        "label": recipe.label, "axes": [axis.name for axis in axes], "levels": list(levels),
        "sample": sample.images,  # another generator, other images
    }  # fmt: skip

    def make() -> dict[str, np.ndarray]:
        made = {part: recipe.generate(part) for part in ("learned", "tested")}
        values = {part: {"identity": one.identity, **one.labels}[recipe.label] for part, one in made.items()}
        people = {f"who_{part}": one.identity for part, one in made.items()}
        images, asked = [one.images for one in made.values()], all_angles(axes, levels)
        total, progress = sum(map(len, images)) + len(asked) * len(images[1]), how.stage("generating")
        for axis, angle in asked:
            images.append(recipe.generate("tested", axis=axis, angle=angle).images)
            progress(sum(map(len, images)), total)
        return {"images": np.concatenate(images), **values, **people}

    result = how.memory.recall("generated", inputs, make)
    n_learn, values = len(result["learned"]), np.concatenate((result["learned"], result["tested"]))
    if values.dtype.kind == "f":
        values = np.where(values > np.median(result["learned"]), "above", "below")
    else:  # a class with fewer than two training images is not asked
        names, counts = np.unique(values[:n_learn].astype(str), return_counts=True)
        values = np.where(np.isin(values.astype(str), names[counts > 1]), values.astype(str), "")
    if len(set(values[:n_learn]) - {""}) < 2:
        what = f"fewer than two values of {recipe.label!r} have two images to learn from"
        raise ValueError(f"{what}: make more people, or more images of each")
    unit = np.arange(len(values))
    if recipe.label != "identity":
        people = np.concatenate((result["who_learned"], result["who_tested"]))
        unit = np.unique(people, return_inverse=True)[1]
    source, task = f"{recipe.label} of generated {recipe.kind}", task_of({recipe.label: values})
    dropped = int((~task.known).sum())
    return Trial(result["images"], *stacked(task, unit, n_learn, axes, levels), source, dropped)


def rendered_trial(
    model: Any, pictures: ImageSet, task: Task, learn: np.ndarray, test: np.ndarray, axes: Sequence[Axis],
    levels: tuple[float, ...], how: Options, groups: np.ndarray | None = None,
) -> Trial:  # fmt: skip
    """Re-render images at the model's size, or find them in the cache.

    ``learn`` and ``test`` are row numbers, ``levels`` degrees. Images of one of the (N,) ``groups``, such as
    identities, are resampled together; an image without one, and all without groups, by itself.
    """
    asked, rows = all_angles(axes, levels), np.concatenate((learn, test))
    inputs = {
        "weights": model_fingerprint(model), "images": pictures.images[rows], "n_learn": len(learn),
        "asked": [[axis.name, angle] for axis, angle in asked],
    }  # fmt: skip

    def rendered(rows: np.ndarray, angles: Sequence[tuple[Axis, float] | None]) -> list[np.ndarray]:
        def render(batch: torch.Tensor) -> list[np.ndarray]:
            scene, result = model.decompose(batch), []
            for one in angles:
                rendering = model.render(scene if one is None else one[0].rotated(scene, one[1]))
                image = fill_uncovered(rendering.image.float(), rendering.mask.float(), batch)
                result.append((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
            return result

        progress = how.stage("re-rendering")
        parts = map_batches(render, model, pictures.images[rows], batch_size=64, progress=progress)
        return [np.concatenate(part) for part in zip(*parts, strict=True)]

    images = how.memory.recall_one(
        "rendered", inputs, lambda: np.concatenate((*rendered(rows, [None]), *rendered(test, asked)))
    )
    number = np.arange(len(pictures))
    if groups is not None:  # an image without a group stands alone
        group = np.unique(groups.astype(str), return_inverse=True)[1]
        number = np.where(missing(groups), len(groups) + number, group)
    source, dropped = f"images of {pictures.layout} re-rendered", int((~task.known).sum())
    parts = stacked(task.select(rows), number[rows], len(learn), axes, levels)
    return Trial(images, *parts, source, dropped)


def true_angle_trial(pictures: ImageSet, task: Task, axes: Sequence[Axis], *, portions: int = 3) -> Trial:
    """Divide images along every axis by their true angles, the more rotated half into portions."""
    tracks = pictures.labels.get("track", np.arange(len(pictures)))
    unit = np.unique(tracks, return_inverse=True)[1].astype(np.int64)
    curves = tuple(_curve(axis, axis.true_deg(pictures.labels), unit, task, portions) for axis in axes)
    how = f"the less and the more rotated half of {pictures.layout}"
    return Trial(pictures.images, task, unit, curves, how, int((~task.known).sum()))


def _curve(axis: Axis, angle: np.ndarray, unit: np.ndarray, task: Task, portions: int) -> Curve:
    usable = task.known & np.isfinite(angle)
    rows_of = {one: np.flatnonzero(usable & (unit == one)) for one in np.unique(unit[usable]).tolist()}
    by_angle = sorted(rows_of, key=lambda one: (float(angle[rows_of[one]].mean()), one))
    classes: dict[bytes, list[int]] = {}  # of the first row; all together where labels are several
    several = task.kind != "classes" and task.targets.shape[1] > 1
    for one in by_angle:
        classes.setdefault(b"" if several else task.targets[rows_of[one][0]].tobytes(), []).append(one)
    near = [members[: len(members) // 2] for members in classes.values()]
    taken = {one for members in near for one in members}
    far = np.array_split(np.array([one for one in by_angle if one not in taken], np.int64), portions)

    def rows(members: Sequence[int] | np.ndarray) -> np.ndarray:
        return np.sort(np.concatenate([rows_of[int(one)] for one in members] or [np.zeros(0, np.int64)]))

    learn = rows([one for members in near for place, one in enumerate(members) if place % 4 != 2])
    ordinary = [one for members in near for one in members[2::4]]
    tested = tuple(rows(part) for part in (ordinary, *(part for part in far if len(part))))
    levels = tuple(float(angle[part].mean()) if len(part) else float("nan") for part in tested)
    if len(levels) < 2 or not all(b - a > 1e-6 for a, b in pairwise(levels)):
        what = f"the true {axis.title} cannot be cut into {portions} portions of growing angle"
        raise ValueError(f"{what}: the images are too few, or all at one angle")
    return Curve(axis.name, f"true {axis.title}", learn, levels, (tested[0], *tested))
