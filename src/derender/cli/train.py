"""`derender train`: pre-training on a folder of images."""

from typing import Annotated

import typer

from derender.cli.console import is_main_process, notice, result, write_json
from derender.cli.gathered import command
from derender.cli.options import DataOptions, Device, Json, Settings
from derender.cli.runs import DryRun, OutRun, Resume, dry_run_shown, report_run, run_progress
from derender.storage.places import bundled_renderers

MODEL = "Instead of derender: vqvae, simclr, ae, beta-vae, resnet18, stylegan2, e4e or ris."
Network = Annotated[str | None, typer.Option("--model", metavar="NAME", help=MODEL)]
PRESET = "faces (the default with a graphics card), cars, cats, paper, or small (without one)."
Preset = Annotated[str | None, typer.Option("--preset", help=PRESET)]
START_FROM = "Begin with a trained model's weights: a run folder, a bundled name or a Hub id."
StartFrom = Annotated[str | None, typer.Option("--start-from", metavar="MODEL", help=START_FROM)]
LOOCC = "Contrast over none, light, light+camera or all factors; names joined by +."
Loocc = Annotated[str | None, typer.Option("--loocc", help=LOOCC)]
RENDERER = f"How scenes make images: {', '.join(bundled_renderers())}, or several joined by +."
Renderer = Annotated[str | None, typer.Option("--renderer", metavar="NAME", help=RENDERER)]
GENERATOR = "Run of stylegan2 for which e4e is trained."
Generator = Annotated[str | None, typer.Option("--generator", metavar="RUN", help=GENERATOR)]
CONFIG = "Settings in YAML, such as a run's; options come after."
ConfigFile = Annotated[str | None, typer.Option("--config", metavar="FILE", help=CONFIG)]


@command("train", "train photos/ --preset faces --out runs/faces")
def train(
    images: DataOptions, out: OutRun, model: Network = None, preset: Preset = None,
    start_from: StartFrom = None, loocc: Loocc = None, renderer: Renderer = None, generator: Generator = None,
    config: ConfigFile = None, settings: Settings = None, resume: Resume = False, dry_run: DryRun = False,
    device: Device = "auto", json_file: Json = None,
) -> None:  # fmt: skip
    """Learn to decompose images from a folder of unlabelled images of one kind of object."""
    from derender import learn

    changes = [*(settings or ()), *([] if generator is None else [f"generator={generator}"])]
    chosen = learn.run_settings(
        out, model=model, preset=preset, start_from=start_from, loocc=loocc, renderer=renderer, config=config,
        settings=changes, resume=resume, device=device,
    )  # fmt: skip
    if preset is None and not resume and getattr(chosen, "preset", "") == "small":
        notice("preset small: there is no graphics card; faces has 16 times the work (--preset faces)")
    if start_from is not None and preset is not None:
        notice(f"sizes and ranges are those of {start_from}; preset {preset} says how it is trained")
    if dry_run:
        dry_run_shown(chosen, json_file)
        return
    with run_progress() as how:
        run = learn.train(
            images.address, out=out, config=chosen, resume=resume, device=device, **images.how, **how
        )
    if is_main_process():
        report_run(run)
        result(f"model {run.folder}", json_file)
        result(f"report {out / 'report.html'}", json_file)
        write_json(json_file, {"run": run, "report": out / "report.html"})
