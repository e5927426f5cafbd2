"""The robustness protocol: from models and images to curves beside controls, in one call."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from derender.data import ImageSet, suggestion
from derender.evaluation.bootstrap import RESAMPLES
from derender.evaluation.controls import control_rows
from derender.evaluation.feature_rows import (
    DEFAULT_FACTORS,
    FeatureRow,
    ModelSource,
    StageProgress,
    aligned,
    chosen_labels,
    embedded_table,
    prepare,
    sized,
    stage,
)
from derender.evaluation.linear_probes import check_head
from derender.evaluation.linear_task import divide_rows, task_of
from derender.evaluation.memory import Memory, memory_in
from derender.evaluation.robust.compare import AREA, SCORES, compare_robustness
from derender.evaluation.robust.sources import (
    KINDS,
    Recipe,
    generated_trial,
    rendered_trial,
    true_angle_trial,
)
from derender.evaluation.robust.trial import LEVELS, checked_levels, chosen_axes
from derender.evaluation.score_table import Scores, verdict
from derender.features import FeatureTable, table_labels
from derender.inputs import as_model

WAYS = (*KINDS, "render", "truth")


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
    factors: Sequence[str] | None = DEFAULT_FACTORS,
    head: str = "logistic",
    score: str = "accuracy",
    seeds: int = 5,
    untrained_seeds: int = 5,
    resamples: int = RESAMPLES,
    seed: int = 0,
    dataset: str = "auto",
    limit: int | None = None,
    device: str = "auto",
    cache: Memory | str | Path | None = None,
    progress: StageProgress | None = None,
) -> Scores:
    """Does a probe learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Args:
        models: a model, or several by name; the first one re-renders, and is the subject of the tables.
        images: to re-render, or with true angles among their labels; None where images are generated.
        images: "faces" or "cars" (generated), "render" or "truth"; by default faces, with images render.
        label: the question: by default identity, of cars their class; several yes/no labels are averaged.
        attributes: ask every yes/no label of the images.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        groups: label whose rows stay on one side of the split.
        test_fraction: tested share of the images that are re-rendered.
        axes, angles: names of ``AXES``, and degrees off the front, growing.
        people, learned, tested: of generated images, see ``Recipe``.
        factors: features that are used together; None means all.
        head: kind of probe.
        score: "accuracy" or "balanced_accuracy", shown in the tables.
        seeds, untrained_seeds: numbers of training subsets and of untrained encoders.
        resamples: bootstrap resamples.
        seed: of generated images, subsets, encoders and resamples.
        dataset, limit: how an address of images is read.
        device: of models that are loaded here.
        cache: folder of cached results, or "none"; by default the user's.
        progress: called with (done, total) and the stage.

    Returns:
        The tables; ``result`` is the ``RobustnessComparison``.
    """
    way = pictures or ("faces" if images is None else "render")
    if way not in WAYS:
        raise ValueError(f"images {way!r} is unknown{suggestion(way, WAYS)}: choose {', '.join(WAYS)}")
    generated, names = way in KINDS, [label] if isinstance(label, str) else list(label or ())
    if generated == (images is not None):
        what = "are generated and take no images" if generated else "need images"
        raise ValueError(f"images {way!r} {what}")
    if generated and (attributes or groups or len(names) > 1):
        raise ValueError(f"images {way!r} are asked one label; attributes and groups need images")
    if score not in SCORES:
        raise ValueError(f"unknown score {score!r}{suggestion(score, SCORES)}: choose {', '.join(SCORES)}")
    check_head(head)
    turned = chosen_axes(axes, way if generated else None)
    levels, memory = checked_levels(angles, turned), memory_in(cache)
    sources = models if isinstance(models, Mapping) else {"model": models}
    nets = {name: as_model(source, device=device) for name, source in sources.items()}
    first, notes = next(iter(nets.values())), []
    if generated:
        name = names[0] if names else KINDS[way].label
        recipe = Recipe(way, name, people, learned, tested, first.image_size, seed)
        report = stage(progress, "generating")
        trial = generated_trial(recipe, turned, levels, memory=memory, progress=report)
    else:
        reader = sized(images, dataset=dataset, limit=limit, progress=progress)
        assert reader is not None
        read = reader.at(first.image_size)
        columns = FeatureTable(read.files, {"none": np.zeros((len(read), 1))}, table_labels(read))
        if not names and not attributes:
            names = [name for name in ("identity", "class") if name in columns.labels][:1]
        chosen, left = chosen_labels(columns, names, attributes, 2)
        notes += [*reader.notes, *left]
        kept = [groups] if groups else []
        row = FeatureRow("images", (columns,))
        ready = prepare([row], chosen, min_count=min_count, max_count=max_count, keep=kept)
        read, task = aligned(read, ready.files), task_of(ready.labels)
        if way == "truth":
            trial = true_angle_trial(read, task, turned)
        else:
            sides = ready.kept[groups] if groups else None
            how = {"test_fraction": test_fraction, "partition": ready.partition, "groups": sides}
            learn, test = divide_rows(task, ready.files, **how)
            trial = rendered_trial(
                first, read, task, learn, test, turned, levels,
                groups=sides, memory=memory, progress=stage(progress, "re-rendering"),
            )  # fmt: skip
    rows, own = [], None if factors is None else tuple(factors)
    for name, net in nets.items():
        table = embedded_table(net, trial.pictures, memory, stage(progress, f"embedding {name}"))
        joined, prefix = " + ".join(own or table.factors), f"{name}: " if len(nets) > 1 else ""
        rows.append(FeatureRow(f"{prefix}{joined}", (table,), own))
        if len(rows) == 1:
            single = [one for one in table.factors if one != joined]
            rows += [FeatureRow(f"{prefix}{one}", (table,), (one,)) for one in single]
    rows += control_rows(
        trial.pictures, first.settings, own, range(seed, seed + untrained_seeds),
        memory=memory, device=device, fit_on=trial.pictures.select(trial.learned), progress=progress,
    )  # fmt: skip
    found = compare_robustness(
        {row.name: [table.concatenate(row.factors) for table in row.tables] for row in rows},
        trial,
        tuple(range(seed, seed + seeds)),
        controls=[row.name for row in rows if row.control],
        head=head,
        resample_count=resamples,
        seed=seed,
        memory=memory,
        progress=stage(progress, "probing", "probes"),
    )
    notes += [f"{len(trial.images):,} images: {trial.how}"]
    notes += [f"{curve.title}: {verdict(curve.rows[score][0], AREA)}" for curve in found.curves]
    address = images.source if isinstance(images, ImageSet) else images
    values = {"pictures": way, "data": None if address is None else str(address), **found.numbers()}
    return Scores(found.tables(score), values, [*notes, memory.summary()], result=found)
