"""`derender finetune`: encoders trained by rendering and by labels at once."""

from dataclasses import dataclass
from typing import Annotated

import typer

from derender.cli import scoring
from derender.cli.console import progress_bar, result, write_json
from derender.cli.gathered import gathered
from derender.cli.options import DataOptions, Device, Settings
from derender.cli.runs import DryRun, OutRun, Resume, report_read, report_run, show_progress


@dataclass(frozen=True)
class Choices:
    """What is trained, from where, and how; named as in `derender.finetune`."""

    labels: Annotated[
        list[str] | None, typer.Option("--label", "-l", help="Label column; several if each has two values.")
    ] = None
    attributes: Annotated[bool, typer.Option("--attributes", help="Learn every yes/no label.")] = False
    model: Annotated[
        str | None,
        typer.Option("--model", "-m", help="Run or saved model to start from; else fresh weights."),
    ] = None
    preset: Annotated[str | None, typer.Option("--preset", help="Preset of fresh weights.")] = None
    weight: Annotated[float | None, typer.Option("--weight", help="Weight of the labels; default 1.")] = None
    rendering_weight: Annotated[
        float | None, typer.Option("--rendering-weight", help="Weight of the rendering objective; default 1.")
    ] = None
    labelled: Annotated[
        int | None,
        typer.Option("--labelled", min=2, metavar="N", help="Use the labels of N training images."),
    ] = None
    factors: Annotated[
        str | None,
        typer.Option("--factors", help="Codes the head takes, with commas; default geometry,albedo."),
    ] = None
    settings: Settings = None
    resume: Resume = False


def register(app: typer.Typer) -> None:
    app.command(
        "finetune",
        epilog="Example: derender finetune lfw.zip -m runs/faces --label emotion --out runs/emotion",
    )(finetune)


@gathered
def finetune(
    images: DataOptions, out: OutRun, published: scoring.Published, choices: Choices,
    dry_run: DryRun = False, device: Device = "auto", cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Train the encoders with a head on labels and with the rendering objective at once, then score them.

    The run folder is as that of derender train: load, embed and every evaluation take it. The test part of
    its split is scored beside the majority and beside heads on the frozen features that training began with.
    """
    from derender import learn
    from derender.evaluation.memory import memory_in
    from derender.training.config import to_yaml

    published.check()
    if dry_run:
        config = learn.finetune_settings(out, **vars(choices))
        result(to_yaml(config).rstrip(), published.json_file)
        write_json(published.json_file, config.model_dump(mode="json"))
        return
    memory = memory_in(cache)
    with progress_bar("reading") as report:
        made = learn.finetune(
            images.address, out=out, **images.how, device=device, memory=memory, on_images=report_read,
            progress=show_progress(report), **vars(choices),
        )  # fmt: skip
    report_run(made.run)
    notes = [one.text(name) for name, one in made.scores.versus.items()]
    result(f"model {made.run.folder}", published.json_file)
    result(f"report {out / 'report.html'}", published.json_file)
    values = {"run": made.run, "report": out / "report.html", "scores": made.scores.numbers()}
    table = made.scores.table(made.start or "fresh weights")
    published.show([table], values, [*notes, scoring.remembered(memory)])
