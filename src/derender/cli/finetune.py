"""`derender finetune`: encoders trained by rendering and by labels at once."""

from dataclasses import dataclass, replace

from derender.cli import scoring
from derender.cli.options import DataOptions, Device, Settings, command, option
from derender.cli.runs import DryRun, OutRun, Resume, dry_run_shown, report_run, run_progress


@dataclass(frozen=True)
class Choices:
    """What is trained, from where, and how; named as in `derender.finetune`."""

    labels: list[str] | None = option(None, "Label column; several if each has two values.", "--label", "-l")
    attributes: bool = option(False, "Learn every yes/no label.", "--attributes")
    model: str | None = option(None, "Run or saved model to start from; else fresh weights.", "--model", "-m")
    preset: str | None = option(None, "Preset of fresh weights.")
    weight: float | None = option(None, "Weight of the labels; default 1.")
    rendering_weight: float | None = option(None, "Weight of the rendering objective; default 1.")
    labelled: int | None = scoring.number(None, "Use the labels of N training images.", min=2)
    factors: str | None = option(None, "Codes the head takes, with commas; default geometry,albedo.")
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

    if dry_run:
        dry_run_shown(learn.finetune_settings(out, **vars(choices)), published.json_file)
        return
    memory = memory_in(cache)
    with run_progress() as how:
        how |= {**images.how, "device": device, "memory": memory}
        made = learn.finetune(images.address, out=out, **how, **vars(choices))
    report_run(made.run)
    published.result(f"model {made.run.folder}")
    published.result(f"report {out / 'report.html'}")
    values = {"run": made.run, "report": out / "report.html", "scores": made.scores.values}
    published.publish(replace(made.scores, values=values, notes=[*made.scores.notes, memory.summary()]))
