"""Where the images of a trial come from: a generator, a model that re-renders, or labels of the true angles.

generated  Light and view were set; all else depends on seed and index alone. Each image is shown from both
           sides. Probes learn in the generator's usual light and view. For identity other images of the same
           people are tested, for any other label other people.
rendered   Real images are decomposed and re-rendered by a model. Training images are renderings too, each in
           its own light and view. Angles are the model's own, and its features have an advantage: read it
           beside generated images.
true       The unit is the track where there are tracks, else the image. Of every class, the less rotated
           half of its units is ordinary: three of four learn, the fourth is tested as the curve's first
           point. The other half is tested in portions, by growing angle.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from derender.data import ImageSet
from derender.data.synthetic import CarSettings, FaceSettings, SyntheticSet, cars, faces
from derender.evaluation.linear_task import Task, task_of
from derender.evaluation.memory import Memory
from derender.evaluation.robust.trial import Axis, Curve, Trial, all_angles, stacked_trial
from derender.features import Progress, map_batches, missing, model_fingerprint, named
from derender.settings import Settings
from derender.training.step import fill_uncovered


@dataclass(frozen=True)
class Kind:
    """A generator and the names of its settings."""

    generate: Callable[..., SyntheticSet]
    settings: Callable[..., Settings]
    images_each: str
    first_one: str
    label: str


KINDS: Mapping[str, Kind] = {
    "faces": Kind(faces.generate, FaceSettings, "pictures_per_identity", "first_identity", "identity"),
    "cars": Kind(cars.generate, CarSettings, "pictures_per_model", "first_model", "class"),
}


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
            raise ValueError(
                f"generated images need two people or more, each with an image to learn from and one to "
                f"test; got {self.people} people, {self.learned} and {self.tested} images"
            )

    def generate(
        self, part: str, count: int | None = None, axis: Axis | None = None, angle: float = 0.0
    ) -> SyntheticSet:
        """Images of ``part`` "learned" or "tested", in usual light and view or at a fixed angle in degrees.

        Both parts count people so that numbers agree; indices of images never do, so no seed is shared.
        """
        kind, each = KINDS[self.kind], getattr(self, part)
        start = -(-self.people * self.learned // self.tested)  # people before the first one tested
        fixed: dict[str, Any] = {kind.images_each: each}
        if part == "learned":  # of another label than identity other people are tested
            fixed[kind.first_one] = start + (self.people if self.label != "identity" else 0)
        if axis is not None:
            usual = getattr(kind.settings(), axis.part).model_dump()
            fixed[axis.part] = {**usual, **axis.fixed(self.kind, angle)}
        first = 0 if part == "learned" else start * self.tested
        number = self.people * each if count is None else count
        return kind.generate(number, self.image_size, self.seed, kind.settings(**fixed), first=first)


def generated_trial(
    recipe: Recipe,
    axes: Sequence[Axis],
    levels: tuple[float, ...],
    *,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> Trial:
    """Generate the images, or find them in the cache."""
    sample = recipe.generate("tested", 1)
    named({"identity": sample.identity, **sample.labels}, recipe.label, f"label of generated {recipe.kind}")
    inputs = {
        "recipe": {name: getattr(recipe, name) for name in ("kind", "people", "learned", "tested", "seed")},
        "label": recipe.label, "axes": [axis.name for axis in axes], "levels": list(levels),
        "sample": sample.images,  # another generator, other images
    }  # fmt: skip

    def make() -> dict[str, np.ndarray]:
        images, result, asked = [], {}, all_angles(axes, levels)
        for part in ("learned", "tested"):
            made = recipe.generate(part)
            images.append(made.images)
            result[part] = {"identity": made.identity, **made.labels}[recipe.label]
            result[f"who_{part}"] = made.identity
        total = sum(map(len, images)) + len(asked) * len(images[1])
        for axis, angle in asked:
            images.append(recipe.generate("tested", axis=axis, angle=angle).images)
            if progress is not None:
                progress(sum(map(len, images)), total)
        return {"images": np.concatenate(images), **result}

    result = (memory or Memory()).recall("generated", inputs, make)
    n_learn, values = len(result["learned"]), np.concatenate((result["learned"], result["tested"]))
    if values.dtype.kind == "f":
        values = np.where(values > np.median(result["learned"]), "above", "below")
    else:  # a class with fewer than two training images is not asked
        names, counts = np.unique(values[:n_learn].astype(str), return_counts=True)
        values = np.where(np.isin(values.astype(str), names[counts > 1]), values.astype(str), "")
    if len(set(values[:n_learn]) - {""}) < 2:
        raise ValueError(
            f"fewer than two values of {recipe.label!r} have two images to learn from: make more people, "
            "or more images of each"
        )
    unit = np.arange(len(values))
    if recipe.label != "identity":
        people = np.concatenate((result["who_learned"], result["who_tested"]))
        unit = np.unique(people, return_inverse=True)[1]
    how, dropped = f"{recipe.label} of generated {recipe.kind}", int(missing(values).sum())
    task = task_of({recipe.label: values})
    return stacked_trial(result["images"], task, unit, n_learn, axes, levels, how, dropped)


def rendered_trial(
    model: Any,
    pictures: ImageSet,
    task: Task,
    learn: np.ndarray,
    test: np.ndarray,
    axes: Sequence[Axis],
    levels: tuple[float, ...],
    *,
    groups: np.ndarray | None = None,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> Trial:
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

        parts = map_batches(render, model, pictures.images[rows], batch_size=64, progress=progress)
        return [np.concatenate(part) for part in zip(*parts, strict=True)]

    images = (memory or Memory()).recall_one(
        "rendered", inputs, lambda: np.concatenate((*rendered(rows, [None]), *rendered(test, asked)))
    )
    number = np.arange(len(pictures))
    if groups is not None:  # an image without a group stands alone
        group = np.unique(groups.astype(str), return_inverse=True)[1]
        number = np.where(missing(groups), len(groups) + number, group)
    how, dropped = f"images of {pictures.layout} re-rendered", int((~task.known).sum())
    return stacked_trial(images, task.select(rows), number[rows], len(learn), axes, levels, how, dropped)


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
        raise ValueError(
            f"the true {axis.title} cannot be cut into {portions} portions of growing angle: the images "
            "are too few, or all at one angle"
        )
    return Curve(axis.name, f"true {axis.title}", learn, levels, (tested[0], *tested))
