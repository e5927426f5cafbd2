"""Joint training with labels, and its held-out scores."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from derender.baselines import read_any_config
from derender.data import ImageSet
from derender.evaluation.finetuning import (
    FinetuneScores,
    FinetuneTask,
    load_finetuned,
    score_finetuned,
    target_of,
)
from derender.evaluation.memory import Memory
from derender.inputs import as_images, as_model, device_named
from derender.learn.runs import Changes, OnImages, texts_of
from derender.training.config import PRESETS, FinetuneConfig, TrainConfig, resolve, with_changes
from derender.training.loop import train_task
from derender.training.run_folder import refuse_taken
from derender.training.task import Progress, TrainResult


@dataclass(frozen=True)
class Finetuned:
    """A joint training with labels: how it ended, scores of its test part, the model it began with."""

    run: TrainResult
    scores: FinetuneScores
    start: str | None


def finetune_settings(
    out: str | Path, *, model: str | Path | None = None, preset: str | None = None,
    labels: Sequence[str] | None = None, attributes: bool = False,
    factors: Sequence[str] | str | None = None, weight: float | None = None,
    rendering_weight: float | None = None, labelled: int | None = None, settings: Changes | None = None,
    resume: bool = False,
) -> FinetuneConfig:  # fmt: skip
    """The settings of a joint training; arguments as for `finetune`."""
    names = locals()
    if resume:
        if not (Path(out) / "config.yaml").is_file():
            raise FileNotFoundError(
                f"no run to resume in {out} (no config.yaml): run it without resume first"
            )
        config = read_any_config(Path(out))
        if not isinstance(config, FinetuneConfig):
            raise ValueError(f"{out} was made by derender train: continue with derender train --resume")
        given = {name: value for name, value in names.items() if name not in ("out", "resume") and value}
        with suppress(ValueError):
            labels = config.target.labels if attributes else None
            if not given or with_changes(finetune_settings(out, **given), target__labels=labels) == config:
                return config
        raise ValueError(f"a resumed run keeps its settings: leave out {', '.join(given)}")
    if model is not None and preset is not None:
        raise ValueError("preset is for fresh weights, model for given ones: give one of them")
    if bool(labels) == attributes:
        raise ValueError("give either labels or attributes")
    if isinstance(factors, str):
        factors = [name.strip() for name in factors.split(",")]
    if model is None:
        config = FinetuneConfig(**resolve(preset or "faces").model_dump(mode="json"))
    else:
        config = read_any_config(Path(model)) if (Path(model) / "config.yaml").is_file() else PRESETS["faces"]
        assert isinstance(config, TrainConfig)
        kept = {"preset", "objective", "batch_size", "horizontal_flips", "split", "precision", "seed"}
        values = config.model_dump(mode="json", include=kept)
        start = as_model(model, device="cpu")
        config = FinetuneConfig(**values, model=start.settings, start=str(model))
    target: dict[str, Any] = {"weight": weight, "rendering_weight": rendering_weight, "labelled": labelled}
    target |= {"labels": list(dict.fromkeys(labels or ())) or None}
    target |= {"factors": None if factors is None else list(factors)}
    changes = {f"target__{name}": value for name, value in target.items()}
    return with_changes(config, texts_of(settings or ()), **changes)


def finetune(
    images: ImageSet | str | Path, *, out: str | Path, dataset: str = "auto", limit: int | None = None,
    device: str = "auto", memory: Memory | None = None, on_images: OnImages | None = None,
    progress: Callable[[Progress], None] | None = None, **choices: Any,
) -> Finetuned:  # fmt: skip
    """Train encoders with a head on labels and with the rendering objective at once, then score them.

    The test part of the run's split is scored, beside heads on the frozen features that training began with.

    Args:
        images: an image set with labels, or its address.
        out: a new run folder, or with ``resume=True`` that of an unfinished run.
        dataset, limit, device, on_images, progress: as for `train`.
        memory: where scores are cached.
        choices: ``labels`` (names of columns) or ``attributes=True`` (every yes/no label). ``model`` to start
            from or ``preset`` of fresh weights. ``factors`` whose codes the head takes. ``weight`` of the
            labels and ``rendering_weight`` in the total. ``labelled``, the number of training images whose
            labels are used. ``settings`` and ``resume`` as for `train`.

    Raises:
        ValueError: unknown labels, settings that do not fit, or a training that collapsed without a model.
    """
    out, report = Path(out), progress or (lambda _: None)
    resume = bool(choices.get("resume"))
    config, accelerator = finetune_settings(out, **choices), device_named(device)
    if not resume:
        refuse_taken(out)
    start = None if config.start is None else as_model(config.start, device="cpu")
    images = as_images(
        images, config.model.network.image_size, dataset=dataset, limit=limit,
        progress=lambda *counts: report(Progress("reading", *counts)),
    )  # fmt: skip
    if on_images is not None:
        on_images(images)
    if choices.get("attributes"):
        config = with_changes(config, target__labels=_attributes(images))
    task = FinetuneTask(config, images.images, target_of(images, config), start)
    how = {"resume": resume, "progress": report, "accelerator": accelerator}
    from derender.report.run import decomposition_sheet, run_page

    run = train_task(
        task, images, out, sample_sheet=lambda tuned, few: decomposition_sheet(tuned.model, few), **how
    )
    run_page(out).write(out / "report.html")
    if not (out / "model").is_dir():
        raise ValueError(f"{out} has no model: training collapsed before the first held-out score")
    tuned = load_finetuned(out, device=accelerator)
    scores = score_finetuned(
        tuned, task, memory=memory, progress=lambda *counts: report(Progress("scoring", *counts))
    )
    return Finetuned(run, scores, config.start)


def _attributes(images: ImageSet) -> list[str]:
    """Every yes/no column that has both values."""
    answers = {name: values for name, values in images.labels.items() if values.dtype == np.int8}
    varied = [name for name, values in answers.items() if {0, 1} <= set(values.tolist())]
    if not varied:
        raise ValueError(f"{images.source} has no yes/no label: name one in labels")
    return varied
