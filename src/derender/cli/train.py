"""`derender train`: pre-training on a folder of images."""

from dataclasses import dataclass

from derender import learn
from derender.cli.console import is_main_process, notice, result, write_json
from derender.cli.options import DataOptions, Device, Json, Settings, command, option
from derender.cli.runs import DryRun, OutRun, Resume, dry_run_shown, report_run, run_progress
from derender.storage.places import bundled_renderers

MODEL = "Instead of derender: vqvae, simclr, ae, beta-vae, resnet18, stylegan2, e4e or ris."
PRESET = "faces (default on a graphics card), small (else), small-faces, small-cars, cars, cats or paper."
START_FROM = "Begin with a trained model's weights: a run folder, a bundled name or a Hub id."
RENDERER = f"How scenes make images: {', '.join(bundled_renderers())}, or several joined by +."


@dataclass(frozen=True)
class Chosen:
    """What is trained, and how; named as in `derender.learn.run_settings`."""

    model: str | None = option(None, MODEL, metavar="NAME")
    preset: str | None = option(None, PRESET)
    start_from: str | None = option(None, START_FROM, metavar="MODEL")
    loocc: str | None = option(None, "Contrast over none, light, light+camera or all; names joined by +.")
    renderer: str | None = option(None, RENDERER, metavar="NAME")
    config: str | None = option(None, "Settings in YAML, as a run's; options come after.", metavar="FILE")
    resume: Resume = False
    device: Device = "auto"


@command("train", "train photos/ --preset faces --out runs/faces")
def train(
    images: DataOptions, out: OutRun, chosen: Chosen,
    generator: str | None = option(None, "Run of stylegan2 for which e4e is trained.", metavar="RUN"),
    settings: Settings = None, dry_run: DryRun = False, json_file: Json = None,
) -> None:  # fmt: skip
    """Learn to decompose images from a folder of unlabelled images of one kind of object."""
    changes = [*(settings or ()), *([] if generator is None else [f"generator={generator}"])]
    config = learn.run_settings(out, settings=changes, **vars(chosen))
    asked = chosen.preset or chosen.config or chosen.resume
    if not asked and getattr(config, "preset", "") == "small":
        notice("preset small: there is no graphics card; faces has 16 times the work (--preset faces)")
    if chosen.start_from is not None and chosen.preset is not None:
        how = f"preset {chosen.preset} says how it is trained"
        notice(f"sizes and ranges are those of {chosen.start_from}; {how}")
    if dry_run:
        dry_run_shown(config, json_file)
        return
    with run_progress() as how:
        how |= {**images.how, "resume": chosen.resume, "device": chosen.device}
        run = learn.train(images.address, out=out, config=config, **how)
    if is_main_process():
        report_run(run)
        result(f"model {run.folder}", json_file)
        result(f"report {out / 'report.html'}", json_file)
        write_json(json_file, {"run": run, "report": out / "report.html"})
