"""`derender evaluate`: one protocol a command, each beside its controls.

A protocol is a function of its name, which takes a place in ``EXAMPLES``.
"""

import typer

from derender.cli.evaluate.disentangle import disentangle
from derender.cli.evaluate.features import cluster, identify, linear, verify
from derender.cli.evaluate.photographs import brightness, light, pose, relight
from derender.cli.evaluate.robustness import robustness
from derender.cli.evaluate.scenes import geometry, reconstruction
from derender.cli.evaluate.segment import segment
from derender.cli.options import command

EXAMPLES = {
    cluster: "lfw.zip --model faces-64 --label identity",
    linear: "celeba.zip --model faces-64 --attributes",
    identify: "CroppedYale.zip --model faces-64",
    verify: "lfw.zip --model faces-64 --pairs pairs.txt",
    segment: "CelebAMask-HQ/ --model runs/unet --out segmented/",
    disentangle: "made/ --model runs/faces --out card.png",
    geometry: "made/::test_gt --model runs/faces",
    reconstruction: "photos/ --model runs/faces --part test",
    pose: "lfw.zip --model faces-64 --table angles.csv",
    light: "CroppedYale.zip --model faces-64",
    relight: "CroppedYale.zip --model faces-64",
    brightness: "made/::test_gt --model runs/faces",
    robustness: "--model runs/faces --out curves.svg",
}


def register(app: typer.Typer) -> None:
    group = typer.Typer(help="Score features or a model, beside controls.", no_args_is_help=True)
    for protocol, words in EXAMPLES.items():
        name = protocol.__name__
        command(name, f"evaluate {name} {words}")(protocol).register(group)
    app.add_typer(group, name="evaluate")
