"""The robustness protocol: from models and images to curves beside controls, in one call."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from derender.data import ImageSet
from derender.evaluation.controls import control_rows
from derender.evaluation.feature_rows import FeatureRow, ModelSource, chosen_labels, embedded_table, prepare
from derender.evaluation.linear_probes import PROBES
from derender.evaluation.linear_task import divide_rows, task_of
from derender.evaluation.options import Options
from derender.evaluation.robust import sources
from derender.evaluation.robust.compare import AREA, SCORES, compare_robustness
from derender.evaluation.robust.trial import LEVELS, checked_levels, chosen_axes
from derender.evaluation.score_table import Scores, verdict
from derender.features import FeatureTable, named, table_labels
from derender.inputs import as_model

WAYS = (*sources.KINDS, "render", "truth")


def robustness(
    models: Mapping[str, ModelSource] | ModelSource,
    images: ImageSet | str | Path | None = None,
    *,
    pictures: str | None = None,
    label: str | Sequence[str] | None = None,
    attributes: bool = False,
    min_count: int = 1,
    max_count: int | None = None,
    groups: str | None = None,
    test_fraction: float = 0.3,
    axes: Sequence[str] = ("yaw", "light"),
    angles: Sequence[float] = LEVELS,
    people: int = 40,
    learned: int = 8,
    tested: int = 2,
    head: str = "logistic",
    score: str = "accuracy",
    seeds: int = 5,
    untrained_seeds: int = 5,
    **options: Any,
) -> Scores:
    """Does a probe learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Args:
        models: a model, or several by name; the first one re-renders, and is the subject of the tables.
        images: to re-render, or with true angles among their labels; None where images are generated.
        pictures: "faces" or "cars" (generated), "render" or "truth"; by default faces, with images render.
        label: the question: by default identity, of cars their class; several yes/no labels are averaged.
        attributes: ask every yes/no label of the images.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        groups: label whose rows stay on one side of the split.
        test_fraction: tested share of the images that are re-rendered.
        axes, angles: names of ``AXES``, and degrees off the front, growing.
        people, learned, tested: of generated images, see ``Recipe``.
        head: kind of probe.
        score: "accuracy" or "balanced_accuracy", shown in the tables.
        seeds, untrained_seeds: numbers of training subsets and of untrained encoders.
        options: factors, seed, resamples, cache, ...: the fields of ``Options``.

    Returns:
        The tables; ``result`` is the ``RobustnessComparison``.
    """
    how = Options(images=images, untrained_seeds=untrained_seeds, **options)
    way = pictures or ("faces" if images is None else "render")
    named(dict.fromkeys(WAYS), way, "kind of images")
    named(SCORES, score, "score")
    named(PROBES, head, "head")
    generated, names = way in sources.KINDS, [label] if isinstance(label, str) else list(label or ())
    if generated == (images is not None):
        what = "are generated and take no images" if generated else "need images"
        raise ValueError(f"images {way!r} {what}")
    if generated and (attributes or groups or len(names) > 1):
        raise ValueError(f"images {way!r} are asked one label; attributes and groups need images")
    turned = chosen_axes(axes, way if generated else None)
    levels = checked_levels(angles, turned)
    given = models if isinstance(models, Mapping) else {"model": models}
    nets = {name: as_model(one, device=how.device) for name, one in given.items()}
    first = next(iter(nets.values()))
    if generated:
        name = names[0] if names else sources.KINDS[way].label
        recipe = sources.Recipe(way, name, people, learned, tested, first.image_size, how.seed)
        trial = sources.generated_trial(
            recipe, turned, levels, memory=how.memory, progress=how.stage("generating")
        )
    else:
        read = how.at(first.image_size)
        columns = FeatureTable(read.files, {"none": np.zeros((len(read), 1))}, table_labels(read))
        if not names and not attributes:
            names = [name for name in ("identity", "class") if name in columns.labels][:1]
        chosen, left_out = chosen_labels(columns, names, attributes, 2)
        how.notes.extend(left_out)
        sizes = {"min_count": min_count, "max_count": max_count}
        ready = prepare([FeatureRow("images", (columns,))], chosen, **sizes)
        side = ready.table.label(groups) if groups else None
        read, task = how.at(first.image_size, ready.table.files), task_of(ready.labels)
        if way == "truth":
            trial = sources.true_angle_trial(read, task, turned)
        else:
            parts = divide_rows(task, **ready.split, test_fraction=test_fraction, groups=side)
            progress = how.stage("re-rendering")
            trial = sources.rendered_trial(
                first, read, task, *parts, turned, levels, groups=side, memory=how.memory, progress=progress
            )
    rows = []
    for name, net in nets.items():
        table = embedded_table(net, trial.pictures, how.memory, how.stage(f"embedding {name}"))
        joined, prefix = " + ".join(how.chosen or table.factors), f"{name}: " if len(nets) > 1 else ""
        rows.append(FeatureRow(f"{prefix}{joined}", (table,), how.chosen))
        if len(rows) == 1:
            single = [one for one in table.factors if one != joined]
            rows += [FeatureRow(f"{prefix}{one}", (table,), (one,)) for one in single]
    learn_from = trial.pictures.select(trial.learned)
    rows += control_rows(trial.pictures, first.settings, how, fit_on=learn_from)
    found = compare_robustness(
        {row.name: row.arrays() for row in rows}, trial, how.seeds(seeds),
        controls=[row.name for row in rows if row.control], head=head, resample_count=how.resamples,
        seed=how.seed, memory=how.memory, progress=how.stage("probing", "probes"),
    )  # fmt: skip
    notes = [*how.notes, f"{len(trial.images):,} images: {trial.how}"]
    notes += [f"{curve.title}: {verdict(curve.rows[score][0], AREA)}" for curve in found.curves]
    address = images.source if isinstance(images, ImageSet) else images
    values = {"pictures": way, "data": None if address is None else str(address), **found.numbers()}
    return Scores(found.tables(score), values, [*notes, how.memory.summary()], result=found)
