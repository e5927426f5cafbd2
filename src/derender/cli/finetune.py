"""`derender finetune`: encoders trained by rendering and by labels at once."""

from dataclasses import dataclass, replace
from typing import Annotated

import typer

from derender.cli import scoring
from derender.cli.console import result
from derender.cli.gathered import command
from derender.cli.options import DataOptions, Device, Settings
from derender.cli.runs import DryRun, OutRun, Resume, dry_run_shown, report_run, run_progress

LABEL = "Label column; several if each has two values."
START = "Run or saved model to start from; else fresh weights."
RENDERING = "Weight of the rendering objective; default 1."
FACTORS = "Codes the head takes, with commas; default geometry,albedo."
Labelled = Annotated[
    int | None, typer.Option("--labelled", min=2, metavar="N", help="Use the labels of N training images.")
]


@dataclass(frozen=True)
class Choices:
    """What is trained, from where, and how; named as in `derender.finetune`."""

    labels: Annotated[list[str] | None, typer.Option("--label", "-l", help=LABEL)] = None
    attributes: Annotated[bool, typer.Option("--attributes", help="Learn every yes/no label.")] = False
    model: Annotated[str | None, typer.Option("--model", "-m", help=START)] = None
    preset: Annotated[str | None, typer.Option("--preset", help="Preset of fresh weights.")] = None
    weight: Annotated[float | None, typer.Option("--weight", help="Weight of the labels; default 1.")] = None
    rendering_weight: Annotated[float | None, typer.Option("--rendering-weight", help=RENDERING)] = None
    labelled: Labelled = None
    factors: Annotated[str | None, typer.Option("--factors", help=FACTORS)] = None
    settings: Settings = None
    resume: Resume = False


@command("finetune", "finetune lfw.zip -m runs/faces --label emotion --out runs/emotion")
def finetune(
    images: DataOptions, out: OutRun, published: scoring.Published, choices: Choices, dry_run: DryRun = False,
    device: Device = "auto", cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Train the encoders with a head on labels and with the rendering objective at once, then score them.

    The run folder is as that of derender train: load, embed and every evaluation take it. The test part of
    its split is scored beside the majority and beside heads on the frozen features that training began with.
    """
    from derender import learn
    from derender.evaluation.memory import memory_in

    published.check()
    if dry_run:
        dry_run_shown(learn.finetune_settings(out, **vars(choices)), published.json_file)
        return
    memory = memory_in(cache)
    with run_progress() as how:
        made = learn.finetune(
            images.address, out=out, **images.how, device=device, memory=memory, **how, **vars(choices)
        )
    report_run(made.run)
    result(f"model {made.run.folder}", published.json_file)
    result(f"report {out / 'report.html'}", published.json_file)
    values = {"run": made.run, "report": out / "report.html", "scores": made.scores.values}
    published.publish(replace(made.scores, values=values), memory)
