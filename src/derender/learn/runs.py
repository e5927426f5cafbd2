"""Training runs: settings from every source, and the calls that train a model or a baseline, or finetune."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from derender.baselines import baseline_config, image_size_of, read_any_config, stored_config, train_baseline
from derender.data import ImageSet
from derender.evaluation.feature_rows import attribute_columns
from derender.evaluation.finetuning import FinetuneTask, load_finetuned, score_finetuned, target_of
from derender.evaluation.memory import Memory
from derender.evaluation.score_table import Scores
from derender.inputs import as_images, as_model, device_named
from derender.training import derender_task
from derender.training.config import PRESETS, FinetuneConfig, TrainConfig, as_overrides, resolve, with_changes
from derender.training.distributed import leave, open_fabric, this_rank_writes
from derender.training.loop import train_task
from derender.training.run_folder import read_settings, refuse_taken
from derender.training.task import Progress, TrainResult

OnImages = Callable[[ImageSet], object]  # called with the images once they are read
Changes = Mapping[str, Any] | Sequence[str]  # settings by dotted name, or ``key=value`` texts


def run_settings(
    out: str | Path | None = None, *, model: str | None = None, preset: str | None = None,
    start_from: str | None = None, loocc: str | None = None, renderer: str | None = None,
    config: str | Path | None = None, settings: Changes = (), resume: bool = False,
    device: str = "auto",
) -> Any:  # fmt: skip
    """The settings of a training run.

    Args:
        out: the run folder; with ``resume`` and nothing else the run keeps its own settings.
        model: "derender", or a baseline: vqvae, simclr, ae, beta-vae, resnet18, stylegan2, e4e or ris.
        preset: faces (the default with a graphics card or ``start_from``), small (else), small-faces,
            small-cars, cars, cats or paper; with ``resume`` the run's own.
        start_from: a trained model whose weights the run begins with.
        loocc: factors that are contrasted: "none", "all", or names such as "light+camera".
        renderer: how scenes make images: lambert (the default), lambert-shadow, phong, sh, haze, several
            joined by +, or one of your own, "package.module:thing".
        config: a YAML file of settings, which the other arguments change.
        settings: changes of single settings, as ``{"batch_size": 32}`` or ``["batch_size=32"]``.
        resume: continue the run in ``out``.
        device: "auto", "cpu" or "cuda", where it will train.
    """
    changes = texts_of(settings)
    if config is not None:
        stored = read_settings(Path(config))
        trains, base = str(stored.pop("baseline", "derender")), stored.pop("preset", None)
        for name, value, other in (("model", model, trains), ("preset", preset, base)):
            if None not in (value, other) and value != other:
                raise ValueError(f"{config} is for {other}, not for {value}: leave out {name}")
        model, preset = trains, preset if base is None else str(base)
        changes = [*as_overrides(stored), *changes]
    model, own = model or "derender", None
    if resume and out is not None and (Path(out) / "config.yaml").is_file():
        own = stored_config(Path(out), model)
        model = getattr(own, "baseline", model)
        if not changes and (preset, loocc, start_from, renderer) == (None, None, None, None):
            return own
    if model == "derender":
        if preset is None:
            usual = "faces" if start_from or device_named(device) == "cuda" else "small"
            preset = str(getattr(own, "preset", usual))
        explicit = {"objective__loocc": loocc, "model__renderer": renderer, "start_from": start_from}
        return resolve(preset, changes, **explicit)
    for name, value in (("preset", preset), ("loocc", loocc), ("renderer", renderer)):
        if value is not None:
            raise ValueError(f"{name} is for derender models: leave it out with {model}, or change settings")
    return baseline_config(model, changes)


def train(
    images: ImageSet | str | Path, *, out: str | Path, config: Any = None, resume: bool = False,
    dataset: str = "auto", limit: int | None = None, device: str = "auto", page: bool = True,
    on_images: OnImages | None = None, progress: Callable[[Progress], None] | None = None, **choices: Any,
) -> TrainResult:  # fmt: skip
    """Train a model on unlabelled images of one kind of object, into a run folder with a report page.

    Args:
        images: an image set at the model's size, or a folder, zip, shards or Hugging Face id.
        out: a new run folder, or with ``resume`` that of an unfinished run.
        config: all settings as `run_settings` gives them, or a YAML file.
        resume: continue the run in ``out``; without other arguments with its own settings.
        dataset, limit: the layout's name, or "auto" to recognise it; read at most so many images.
        device: "auto", "cpu" or "cuda".
        page: write a report page, for which the data are examined.
        on_images, progress: called with the images once they are read; called after every step.
        choices: model, preset, start_from, loocc, renderer and settings as for `run_settings`.

    Raises:
        FileExistsError: ``out`` is not empty and ``resume`` was not requested.
        ValueError: images and settings do not fit, or the run to resume has other settings.
        TrainingInterrupted: Ctrl-C or SIGTERM; the run can be resumed.
    """
    out, report = Path(out), progress or (lambda _: None)
    if config is None or isinstance(config, str | Path):
        config = run_settings(out, config=config, resume=resume, device=device, **choices)
    elif choices:
        raise ValueError(f"config holds all settings already: leave out {', '.join(choices)}")
    if resume and not (out / "config.yaml").is_file():
        raise FileNotFoundError(f"no run to resume in {out} (no config.yaml): train without resume first")
    fabric = open_fabric(accelerator := device_named(device))
    if this_rank_writes() and not resume:
        refuse_taken(out)
    with fabric.rank_zero_first(local=True):
        reading = Progress.of("reading", report)
        images = as_images(images, image_size_of(config), dataset=dataset, limit=limit, progress=reading)
    if on_images is not None:
        on_images(images)

    def sheet(*given: Any) -> Any:
        from derender.report.run import sample_sheet  # its import would delay the start by seconds

        return sample_sheet(*given)

    how = {"resume": resume, "progress": report, "accelerator": accelerator, "sample_sheet": sheet}
    make = derender_task.train if isinstance(config, TrainConfig) else train_baseline
    result = make(config, images, out, **how)
    leave()
    if page and this_rank_writes():
        from derender.report.run import Evidence, look_at_data, run_page

        run_page(out, Evidence({"data": look_at_data(images)})).write(out / "report.html")
    return result


def texts_of(settings: Changes | None) -> list[str]:
    """As ``key=value`` texts."""
    return as_overrides(settings) if isinstance(settings, Mapping) else list(settings or ())


@dataclass(frozen=True)
class Finetuned:
    """A joint training with labels: how it ended, scores of its test part, the model it began with."""

    run: TrainResult
    scores: Scores
    start: str | None


def finetune_settings(
    out: str | Path, *, model: str | Path | None = None, preset: str | None = None,
    labels: Sequence[str] | None = None, attributes: bool = False,
    factors: Sequence[str] | str | None = None, weight: float | None = None,
    rendering_weight: float | None = None, labelled: int | None = None, settings: Changes | None = (),
    resume: bool = False,
) -> FinetuneConfig:  # fmt: skip
    """The settings of a joint training; arguments as for `finetune`."""
    if isinstance(factors, str):
        factors = [name.strip() for name in factors.split(",")]
    target: dict[str, Any] = {
        "target__labels": list(dict.fromkeys(labels or ())) or None, "target__factors": factors,
        "target__weight": weight, "target__rendering_weight": rendering_weight, "target__labelled": labelled,
    }  # fmt: skip
    if resume:
        if not (Path(out) / "config.yaml").is_file():
            raise FileNotFoundError(f"no run to resume in {out} (no config.yaml): begin without resume")
        config = read_any_config(Path(out))
        if not isinstance(config, FinetuneConfig):
            raise ValueError(f"{out} was made by derender train: continue with derender train --resume")
        began = {"model": (model, config.start), "preset": (preset, None if config.start else config.preset)}
        differ = [name for name, (given, own) in began.items() if given is not None and str(given) != own]
        differ += [name for name, value in target.items() if with_changes(config, **{name: value}) != config]
        differ += [text for text in texts_of(settings) if with_changes(config, [text]) != config]
        if differ:
            names = ", ".join(name.removeprefix("target__") for name in differ)
            raise ValueError(f"a resumed run keeps its settings: leave out {names}")
        return config
    if model is not None and preset is not None:
        raise ValueError("preset is for fresh weights, model for given ones: give one of them")
    if bool(labels) == attributes:
        raise ValueError("give either labels or attributes")
    if model is None:
        config = FinetuneConfig(**resolve(preset or "faces").model_dump(mode="json"))
    else:
        config = read_any_config(Path(model)) if (Path(model) / "config.yaml").is_file() else PRESETS["faces"]
        assert isinstance(config, TrainConfig)
        kept = {"preset", "objective", "batch_size", "horizontal_flips", "split", "precision", "seed"}
        values = config.model_dump(mode="json", include=kept)
        start = as_model(model, device="cpu")
        config = FinetuneConfig(**values, model=start.settings, start=str(model))
    return with_changes(config, texts_of(settings), **target)


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
    config, accelerator = finetune_settings(out, **choices), device_named(device)
    if not (resume := bool(choices.get("resume"))):
        refuse_taken(out)
    start = None if config.start is None else as_model(config.start, device="cpu")
    size, reading = config.model.network.image_size, Progress.of("reading", report)
    images = as_images(images, size, dataset=dataset, limit=limit, progress=reading)
    if on_images is not None:
        on_images(images)
    if choices.get("attributes"):
        if not (columns := attribute_columns(images.labels, 1)):
            raise ValueError(f"{images.source} has no yes/no label: name one in labels")
        config = with_changes(config, target__labels=list(columns))
    task = FinetuneTask(config, images.images, target_of(images, config), start)
    from derender.report.run import run_page, sample_sheet

    how = {"resume": resume, "progress": report, "accelerator": accelerator}
    run = train_task(task, images, out, **how, sample_sheet=lambda tuned, few: sample_sheet(tuned.model, few))
    run_page(out).write(out / "report.html")
    if not (out / "model").is_dir():
        raise ValueError(f"{out} has no model: training collapsed before the first held-out score")
    tuned = load_finetuned(out, device=accelerator)
    began, scoring = config.start or "fresh weights", Progress.of("scoring", report)
    scores = score_finetuned(tuned, task, began=began, memory=memory, progress=scoring)
    return Finetuned(run, scores, config.start)
