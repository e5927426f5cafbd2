"""`derender train`: pre-training on a folder of images."""

from typing import Annotated

import typer

from derender.cli.console import is_main_process, progress_bar, result, write_json
from derender.cli.gathered import gathered
from derender.cli.options import DataOptions, Device, Json, Settings
from derender.cli.runs import DryRun, OutRun, Resume, report_read, report_run, show_progress

Network = Annotated[
    str | None,
    typer.Option(
        "--model", metavar="NAME",
        help="Instead of derender: vqvae, simclr, ae, beta-vae, resnet18, stylegan2, e4e or ris.",
    ),
]  # fmt: skip
Preset = Annotated[
    str | None, typer.Option("--preset", help="faces (the default), cars, cats, paper, or small for a CPU.")
]
StartFrom = Annotated[
    str | None,
    typer.Option(
        "--start-from", metavar="MODEL",
        help="Begin with a trained model's weights: a run folder, a bundled name or a Hub id.",
    ),
]  # fmt: skip
Loocc = Annotated[
    str | None, typer.Option("--loocc", help="Contrast over none, light, light+camera or all factors.")
]
Generator = Annotated[
    str | None, typer.Option("--generator", metavar="RUN", help="stylegan2 run of e4e, or its published .pt.")
]
ConfigFile = Annotated[
    str | None,
    typer.Option("--config", metavar="FILE", help="Settings in YAML, such as a run's; options come after."),
]


def register(app: typer.Typer) -> None:
    app.command("train", epilog="Example: derender train photos/ --preset faces --out runs/faces")(train)


@gathered
def train(
    images: DataOptions, out: OutRun, model: Network = None, preset: Preset = None,
    start_from: StartFrom = None, loocc: Loocc = None, generator: Generator = None,
    config: ConfigFile = None, settings: Settings = None, resume: Resume = False,
    dry_run: DryRun = False, device: Device = "auto", json_file: Json = None,
) -> None:  # fmt: skip
    """Learn to decompose images from a folder of unlabelled images of one kind of object."""
    from derender import learn
    from derender.training.config import to_yaml

    changes = [*(settings or ()), *([] if generator is None else [f"generator={generator}"])]
    chosen = learn.run_settings(
        out, model=model, preset=preset, start_from=start_from, loocc=loocc, config=config, settings=changes,
        resume=resume,
    )  # fmt: skip
    if dry_run:
        result(to_yaml(chosen).rstrip(), json_file)
        write_json(json_file, chosen.model_dump(mode="json"))
        return
    with progress_bar("reading") as report:
        run = learn.train(
            images.address, out=out, config=chosen, resume=resume, **images.how, device=device,
            on_images=report_read, progress=show_progress(report),
        )  # fmt: skip
    if is_main_process():
        report_run(run)
        result(f"model {run.folder}", json_file)
        result(f"report {out / 'report.html'}", json_file)
        write_json(json_file, {"run": run, "report": out / "report.html"})
