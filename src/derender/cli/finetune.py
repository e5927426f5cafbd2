"""`derender finetune`: encoders trained by rendering and by labels at once."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import duration, notice, progress_bar, report_images, result, write_json
from derender.cli.gathered import gathered

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.model import Derenderer
    from derender.training.config import FinetuneConfig


def register(app: typer.Typer) -> None:
    app.command(
        "finetune",
        epilog="Example: derender finetune -m runs/faces -d lfw.zip --label emotion --out runs/emotion",
    )(finetune)


@gathered
def finetune(
    data: options.Data,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Run folder to make, or to go on with.", metavar="RUN")
    ],
    published: scoring.Published,
    label: Annotated[
        list[str] | None,
        typer.Option("--label", "-l", help="Label column to learn; several if each has two values."),
    ] = None,
    attributes: Annotated[
        bool, typer.Option("--attributes", help="Learn every yes/no label of the data set.")
    ] = False,
    model: Annotated[
        str | None,
        typer.Option("--model", "-m", help="Where to start: a run or a saved model; else fresh weights."),
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", help="Of fresh weights: faces, cars, cats, paper, small.")
    ] = None,
    weight: Annotated[
        float | None, typer.Option("--weight", metavar="W", help="Of the labels in the total; default 1.")
    ] = None,
    rendering_weight: Annotated[
        float | None,
        typer.Option(
            "--rendering-weight", metavar="W", help="Of the rendering objective, 0: labels alone; default 1."
        ),
    ] = None,
    labelled: Annotated[
        int | None,
        typer.Option("--labelled", min=2, metavar="N", help="Use the labels of so many training pictures."),
    ] = None,
    factors: Annotated[
        str | None,
        typer.Option("--factors", help="Features the head reads, with commas; default geometry,albedo."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change one setting; may be repeated.", metavar="KEY=VALUE"),
    ] = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show all settings and stop.")] = False,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
) -> None:
    """Train the encoders with a head on labels and with the rendering objective at once, then score them.

    The run folder is as that of derender train: load, embed and every evaluation take it. The test part of
    its split is scored beside the majority and beside heads on the frozen features that training began with.
    """
    from derender.cli.models import chosen_device, open_model

    published.check()
    used = {
        "--label": label, "--attributes": attributes, "--preset": preset, "--weight": weight,
        "--rendering-weight": rendering_weight, "--labelled": labelled, "--factors": factors,
        "--model": model, "--set": overrides,
    }  # fmt: skip
    accelerator = chosen_device(device)
    if resume:
        given = [name for name, value in used.items() if value not in (None, False, [])]
        if given:
            raise ValueError(f"a resumed run keeps its settings: leave out {', '.join(given)}")
        config = _stored(out)
        start = open_model(config.start, "cpu") if config.start is not None else None
    else:
        if model is not None and preset is not None:
            raise ValueError("--preset is for fresh weights, --model for given ones: give one of them")
        start = None if model is None else open_model(model, "cpu")
        config = _config(model, start, preset, overrides or [])
        config = _changed(
            config,
            target__labels=list(dict.fromkeys(label)) if label else None,
            target__weight=weight,
            target__rendering_weight=rendering_weight,
            target__labelled=labelled,
            target__factors=[name.strip() for name in factors.split(",")] if factors else None,
        )
    if bool(config.target.labels) == attributes:
        raise ValueError("give either --label NAME (may be repeated) or --attributes")
    if dry_run:
        from derender.training.config import to_yaml

        result(to_yaml(config).rstrip(), published.json_file)
        write_json(published.json_file, config.model_dump(mode="json"))
        return

    from derender.data import read_pictures
    from derender.evaluation.finetuning import FinetuneTask, load_finetuned, score_finetuned, target_of
    from derender.report.run import decomposition_sheet, run_page
    from derender.report.tables_finetuning import finetuning_table
    from derender.training.loop import train_task
    from derender.training.run_folder import refuse_taken
    from derender.training.task import Progress

    if not resume:
        refuse_taken(out)
    with progress_bar("reading") as report:
        size = config.model.network.image_size
        pictures = read_pictures(data, size, dataset=dataset, limit=limit, progress=report)
    report_images(pictures)
    if attributes:
        config = _changed(config, target__labels=_attributes(pictures))
    task = FinetuneTask(config, pictures.images, target_of(pictures, config), start)
    with progress_bar("training") as report:

        def show(progress: Progress) -> None:
            if progress.phase == "train":
                speed = f"{progress.images_per_second:.0f} pictures/s"
                report(progress.done, progress.total, speed, description="training", unit="pictures")
            else:
                report(progress.done, progress.total, description="perceptual features", unit="steps")

        trained = train_task(
            task,
            pictures,
            out,
            resume=resume,
            sample_sheet=lambda tuned, images: decomposition_sheet(tuned.model, images),
            progress=show,
            accelerator=accelerator,
        )
    page = run_page(out).write(out / "report.html")
    for finding in trained.findings:
        notice(f"{finding.sign}: {finding.text}; {finding.advice}")
    notice(f"{trained.images:,} pictures in {duration(trained.seconds)}; stopped by: {trained.stopped}")
    if not (out / "model").is_dir():
        raise ValueError(f"{out} kept no model: training collapsed before the first held-out score")
    memory = feature_rows.memory_in(cache)
    with progress_bar("scoring", "heads") as report:
        found = score_finetuned(load_finetuned(out, device=accelerator), task, memory=memory, progress=report)
    table = finetuning_table(found, config.start or "fresh weights")
    notes = [
        f"{name.replace('_', ' ')}: {one.value:+.3f} ({one.low:+.3f} to {one.high:+.3f}) "
        f"against {one.rival}, {'above it' if one.above else 'not above it'}"
        for name, one in found.versus.items()
    ]
    result(f"model {trained.folder}", published.json_file)
    result(f"report {page}", published.json_file)
    values = {"run": trained, "report": page, "scores": found.numbers()}
    published.show([table], values, [*notes, scoring.remembered(memory)])


def _config(
    model: str | None, start: "Derenderer | None", preset: str | None, overrides: list[str]
) -> "FinetuneConfig":
    """Settings of a new run: those of the model it starts from, where it has any, else those of a preset."""
    from derender.baselines import read_any_config
    from derender.training.config import PRESETS, FinetuneConfig, TrainConfig, resolve

    if start is None:
        fresh = resolve(preset or "faces").model_dump(mode="json")
        return _changed(FinetuneConfig(**fresh), overrides)
    assert model is not None
    stored = read_any_config(Path(model)) if (Path(model) / "config.yaml").is_file() else PRESETS["faces"]
    assert isinstance(stored, TrainConfig)
    kept = ("preset", "objective", "batch_size", "horizontal_flips", "split", "precision", "seed")
    values = stored.model_dump(mode="json", include=set(kept))
    return _changed(FinetuneConfig(**values, model=start.settings, start=model), overrides)


def _changed(
    config: "FinetuneConfig", overrides: "list[str] | tuple[str, ...]" = (), **explicit
) -> "FinetuneConfig":
    from derender.training.config import with_changes

    return with_changes(config, overrides, **explicit)


def _stored(out: Path) -> "FinetuneConfig":
    """The settings of the run to go on with."""
    from derender.baselines import read_any_config
    from derender.training.config import FinetuneConfig

    if not (out / "config.yaml").is_file():
        raise FileNotFoundError(f"no run to resume in {out} (no config.yaml): run it without --resume first")
    config = read_any_config(out)
    if not isinstance(config, FinetuneConfig):
        raise ValueError(f"{out} was made by derender train: go on with derender train --resume")
    return config


def _attributes(pictures: "PictureSet") -> list[str]:
    """Every yes/no column that has both answers."""
    import numpy as np

    names = [name for name, values in pictures.labels.items() if values.dtype == np.int8]
    varied = [name for name in names if len(set(pictures.labels[name].tolist()) & {0, 1}) == 2]
    if not varied:
        raise ValueError(f"{pictures.source} has no yes/no label: name one with --label")
    return varied
