"""`derender train`: pre-training on a folder of pictures."""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import (
    duration,
    is_main_process,
    notice,
    progress_bar,
    report_images,
    result,
    write_json,
)


def register(app: typer.Typer) -> None:
    app.command("train", epilog="Example: derender train --data photos/ --preset faces --out runs/faces")(
        train
    )


def train(
    data: options.Data,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Run folder to make, or to go on with.", metavar="RUN")
    ],
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help="Instead of derender: vqvae, simclr, ae, beta-vae, resnet18, stylegan2, e4e or ris.",
            metavar="NAME",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option("--preset", help="faces, cars, cats, paper, or small for a CPU; default: faces."),
    ] = None,
    start_from: Annotated[
        str | None,
        typer.Option(
            "--start-from",
            help="Begin with a trained model's weights: a run folder, a bundled name or a Hub id.",
            metavar="MODEL",
        ),
    ] = None,
    loocc: Annotated[
        str | None, typer.Option("--loocc", help="Contrast over none, light, light+camera or all factors.")
    ] = None,
    generator: Annotated[
        str | None,
        typer.Option("--generator", help="Of e4e: the stylegan2 run, or its published .pt.", metavar="RUN"),
    ] = None,
    config_file: Annotated[
        Path | None,
        typer.Option(
            "--config", help="Settings in YAML, such as a run's; other options come after.", metavar="FILE"
        ),
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
    json_file: options.Json = None,
) -> None:
    """Learn to take pictures apart, from a folder of unlabelled pictures of one kind of thing."""
    from derender.settings import Settings
    from derender.training.config import TrainConfig, as_overrides, resolve, to_yaml

    overrides = [*(overrides or ()), *([] if generator is None else [f"generator={generator}"])]
    if config_file is not None:
        from derender.training.run_folder import read_settings

        told = read_settings(config_file)
        trains, base = str(told.pop("baseline", "derender")), told.pop("preset", None)
        for option, given, found in (("--model", model, trains), ("--preset", preset, base)):
            if None not in (given, found) and given != found:
                raise ValueError(f"{config_file} is for {found}, not for {given}: leave out {option}")
        model, preset = trains, preset if base is None else str(base)
        overrides = [*as_overrides(told), *overrides]
    model = model or "derender"
    settings_given = preset is not None or loocc is not None or start_from is not None or bool(overrides)

    def configuration() -> Settings:
        if resume and not settings_given and (out / "config.yaml").is_file():
            from derender.baselines import stored_config

            return stored_config(out, model)
        if model != "derender":
            from derender.baselines import baseline_config

            for option, value in (("--preset", preset), ("--loocc", loocc)):
                if value is not None:
                    raise ValueError(
                        f"{option} is for our own model: leave it out with --model {model}, or use --set"
                    )
            return baseline_config(model, overrides)
        return resolve(preset or "faces", overrides or [], objective__loocc=loocc, start_from=start_from)

    config = configuration()
    if dry_run:
        result(to_yaml(config).rstrip(), json_file)
        write_json(json_file, config.model_dump(mode="json"))
        return

    from derender.baselines import image_size_of, train_baseline
    from derender.cli.models import chosen_device
    from derender.data import read_pictures
    from derender.report.baseline_sheet import baseline_sheet
    from derender.report.evidence import Evidence, look_at_data
    from derender.report.page import Section
    from derender.report.run import decomposition_sheet, run_page
    from derender.training.derender_task import train as train_model
    from derender.training.distributed import first_then_others, leave, open_fabric
    from derender.training.run_folder import refuse_taken
    from derender.training.task import Progress

    if resume and not (out / "config.yaml").is_file():
        raise FileNotFoundError(f"no run to resume in {out} (no config.yaml): train without --resume first")
    accelerator = chosen_device(device)
    fabric = open_fabric(accelerator)
    if is_main_process() and not resume:
        refuse_taken(out)
    with first_then_others(fabric, local=True), progress_bar("reading") as report:
        pictures = read_pictures(data, image_size_of(config), dataset=dataset, limit=limit, progress=report)
    report_images(pictures)
    if pictures.terms:
        notice(f"on its owners' terms: {pictures.terms}")
    with progress_bar("training") as report:

        def show(progress: Progress) -> None:
            if progress.phase == "train":
                waited = f"{progress.waiting:.1%} waiting for data"
                speed = f"{progress.images_per_second:.0f} pictures/s, {waited}"
                report(progress.done, progress.total, speed, description="training", unit="pictures")
            elif progress.phase == "perceptual":
                report(progress.done, progress.total, description="perceptual features", unit="steps")
            else:
                report(progress.done, progress.total, description="whitening features", unit="pictures")

        how = {"resume": resume, "progress": show, "accelerator": accelerator}
        if isinstance(config, TrainConfig):
            trained = train_model(config, pictures, out, sample_sheet=decomposition_sheet, **how)
        else:
            trained = train_baseline(config, pictures, out, sample_sheet=baseline_sheet, **how)
    leave()
    if not is_main_process():
        return
    examined = Evidence([Section("The data", look_at_data(pictures), "Data")])
    page = run_page(out, examined).write(out / "report.html")
    for finding in trained.findings:
        notice(f"{finding.sign}: {finding.text}; {finding.advice}")
    if trained.stopped == "collapse":
        notice("training on is pointless: what is left is the last good checkpoint and model, if any")
    waited = f"{trained.waiting:.1%} of it waiting for data"
    notice(
        f"{trained.images:,} pictures in {duration(trained.seconds)}, {waited}; stopped by: {trained.stopped}"
    )
    if trained.stopped != "collapse" and trained.model_images not in (None, trained.images):
        notice(
            f"the model has the weights of {trained.model_images:,} pictures, the best on held-out ones; "
            "for those of the end: the same command with --resume --set keep=last"
        )
    result(f"model {trained.folder}", json_file)
    result(f"report {page}", json_file)
    write_json(json_file, {"run": trained, "report": page})
