"""A trial of generated pictures, whose light and view are known because they were set.

A picture's face, expression and background hang on seed and index alone, so that the same test pictures are
made again at every angle: what changes along a curve is the angle. Each is shown from both sides. Probes
learn from pictures of the generator's usual light and view. Who is it: learned and tested are other pictures
of the same people. Anything else is asked about people that nothing was learned from.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.data import suggestion
from derender.data.synthetic import CarSettings, FaceSettings, SyntheticSet, cars, faces
from derender.evaluation.linear_task import task_of
from derender.evaluation.memory import Memory
from derender.evaluation.robustness.axes import Axis, checked_levels, either_side
from derender.evaluation.robustness.trial import Curve, Trial
from derender.features import missing
from derender.settings import Settings

Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Kind:
    """A generator, and what its settings are called."""

    generate: Callable[..., SyntheticSet]
    settings: Callable[..., Settings]
    pictures_each: str
    first_one: str
    label: str


KINDS: Mapping[str, Kind] = {
    "faces": Kind(faces.generate, FaceSettings, "pictures_per_identity", "first_identity", "identity"),
    "cars": Kind(cars.generate, CarSettings, "pictures_per_model", "first_model", "class"),
}


@dataclass(frozen=True)
class Recipe:
    """Which pictures are made.

    Attributes:
        kind: of ``KINDS``.
        label: what is asked: ``identity``, or a label of the generator. Numbers become "above" or "below" the
            median of what is learned from.
        people: how many (or cars); where other people are tested than learned from, so many of each.
        learned, tested: pictures of each.
        image_size: in pixels.
        seed: of the generator.
    """

    kind: str = "faces"
    label: str = "identity"
    people: int = 40
    learned: int = 8
    tested: int = 2
    image_size: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(
                f"no kind {self.kind!r}{suggestion(self.kind, KINDS)}: there is {', '.join(KINDS)}"
            )
        if self.people < 2 or self.learned < 1 or self.tested < 1:
            raise ValueError(
                f"generated pictures need two people or more, each with a picture to learn from and one to "
                f"test; got {self.people} people, {self.learned} and {self.tested} pictures"
            )


def generated_trial(
    recipe: Recipe,
    axes: Sequence[Axis],
    levels: Sequence[float],
    *,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> Trial:
    """Make the pictures, or find them where the same were made before.

    Raises:
        ValueError: an unknown label, angles that cannot be set, fewer than two classes.
    """
    levels = checked_levels(levels, axes)
    apart = recipe.label != "identity"
    sample = seen(recipe, apart, "tested", 1)
    columns = {"identity": sample.identity, **sample.labels}
    if recipe.label not in columns:
        raise ValueError(
            f"generated {recipe.kind} have no label {recipe.label!r}{suggestion(recipe.label, columns)}; "
            f"there is {', '.join(columns)}"
        )
    inputs = {
        "recipe": {name: getattr(recipe, name) for name in ("kind", "people", "learned", "tested", "seed")},
        "apart": apart, "label": recipe.label, "axes": [axis.name for axis in axes], "levels": list(levels),
        "sample": sample.images,  # another generator, other pictures
    }  # fmt: skip
    found = (memory or Memory()).recall(
        "generated", inputs, lambda: _make(recipe, apart, axes, levels, progress)
    )
    n_learn, n_test = len(found["learned"]), len(found["tested"])
    values = _classes(found["learned"], found["tested"])
    if len(set(values[:n_learn]) - {""}) < 2:
        raise ValueError(
            f"fewer than two values of {recipe.label!r} have two pictures to learn from: make more people, "
            "or more pictures of each"
        )
    who = np.concatenate((np.arange(n_learn), n_learn + np.arange(n_test)))
    if apart:
        people = np.concatenate((found["who_learned"], found["who_tested"]))
        who = np.unique(people, return_inverse=True)[1]
    repeats = sum(len(either_side(level)) for level in levels) * len(axes) + 1
    column = np.concatenate((values[:n_learn], np.tile(values[n_learn:], repeats)))
    unit = np.concatenate((who[:n_learn], np.tile(who[n_learn:], repeats))).astype(np.int64)
    known = ~missing(column)
    curves, at = [], n_learn + n_test
    for axis in axes:
        tested = []
        for level in levels:
            count = n_test * len(either_side(level))
            tested.append(_known(known, at, count))
            at += count
        learn, ordinary = _known(known, 0, n_learn), _known(known, n_learn, n_test)
        curves.append(Curve(axis.name, axis.title, learn, ordinary, levels, tuple(tested)))
    how = f"{recipe.label} of generated {recipe.kind}"
    dropped = int((~known[: n_learn + n_test]).sum())
    return Trial(found["images"], task_of({recipe.label: column}), unit, tuple(curves), how, dropped)


def seen(
    recipe: Recipe,
    apart: bool,
    part: str,
    count: int | None = None,
    axis: Axis | None = None,
    angle: float = 0.0,
) -> SyntheticSet:
    """The pictures that are learned from or tested, in usual light and view or with one angle held.

    Both parts count people so that numbers agree; indices of pictures never do, so no draw is shared.

    Args:
        recipe: which pictures.
        apart: whether other people are tested than learned from.
        part: "learned" or "tested".
        count: only so many of them.
        axis, angle: what is held, in degrees.
    """
    kind = KINDS[recipe.kind]
    each = getattr(recipe, part)
    start = -(-recipe.people * recipe.learned // recipe.tested)  # people before the first one tested
    held: dict[str, Any] = {kind.pictures_each: each}
    if part == "learned":
        held[kind.first_one] = start + recipe.people if apart else start
    settings = kind.settings(**held)
    if axis is not None:
        part_of = getattr(settings, axis.part)
        ranges = axis.fixed[recipe.kind](angle)
        settings = kind.settings(**held, **{axis.part: {**part_of.model_dump(), **ranges}})
    first = 0 if part == "learned" else start * recipe.tested
    number = recipe.people * each if count is None else count
    return kind.generate(number, recipe.image_size, recipe.seed, settings, first=first)


def _make(
    recipe: Recipe, apart: bool, axes: Sequence[Axis], levels: Sequence[float], progress: Progress | None
) -> dict[str, np.ndarray]:
    asked = [(axis, angle) for axis in axes for level in levels for angle in either_side(level)]
    total = recipe.people * (recipe.learned + recipe.tested * (1 + len(asked)))
    learned, tested = seen(recipe, apart, "learned"), seen(recipe, apart, "tested")
    images = [learned.images, tested.images]
    for axis, angle in asked:
        images.append(seen(recipe, apart, "tested", axis=axis, angle=angle).images)
        if progress is not None:
            progress(sum(map(len, images)), total)
    return {
        "images": np.concatenate(images),
        **{name: _column(made, recipe.label) for name, made in (("learned", learned), ("tested", tested))},
        "who_learned": learned.identity,
        "who_tested": tested.identity,
    }


def _column(made: SyntheticSet, label: str) -> np.ndarray:
    return made.identity if label == "identity" else made.labels[label]


def _classes(learned: np.ndarray, tested: np.ndarray) -> np.ndarray:
    """Classes as text, learned ones first; empty where fewer than two of the class can be learned from."""
    both = np.concatenate((learned, tested))
    if both.dtype.kind == "f":
        return np.where(both > np.median(learned), "above", "below")
    words = both.astype(str)
    names, counts = np.unique(words[: len(learned)], return_counts=True)
    return np.where(np.isin(words, names[counts > 1]), words, "")


def _known(known: np.ndarray, start: int, count: int) -> np.ndarray:
    return start + np.flatnonzero(known[start : start + count])
