"""`derender decompose`: pictures taken apart, as panels, single images and numbers."""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import bar, result, say, write_json


def register(app: typer.Typer) -> None:
    app.command(
        "decompose", epilog="Example: derender decompose --model runs/faces me.jpg you.png --out apart/"
    )(decompose)


def decompose(
    images: Annotated[list[Path], typer.Argument(help="Pictures to take apart.", metavar="IMAGE...")],
    model: options.Model,
    out: options.OutFolder,
    batch_size: options.BatchSize = 64,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a folder per picture: panel.png, one PNG per factor, scene.json and scene.npz."""
    import numpy as np

    from derender.cli.models import open_model
    from derender.data import Unreadable, read_picture
    from derender.report.files import folder_names, write_decompositions

    net = open_model(model, device)
    readable: dict[Path, np.ndarray] = {}
    refused: dict[Path, str] = {}
    for path in dict.fromkeys(images):
        try:
            readable[path] = read_picture(path, net.image_size)
        except (Unreadable, OSError) as problem:
            refused[path] = " ".join(str(problem).split())
    if not readable:
        raise ValueError(next(iter(refused.values())))
    folders = folder_names(list(readable), out)
    taken = [folder for folder in folders if folder.exists()]
    if taken and not force:
        raise FileExistsError(
            f"{taken[0]} exists already: choose another --out, or add --force to replace it"
        )
    with bar("decomposing") as report:
        written = write_decompositions(
            net, dict(zip(folders, readable.items(), strict=True)), batch_size=batch_size, progress=report
        )
    for path, reason in refused.items():
        say(f"left out {path}: {reason}")
    count = "1 picture" if len(written) == 1 else f"{len(written):,} pictures"
    result(f"{count} in {out}", json_file)
    write_json(json_file, {"out": out, "pictures": written, "refused": refused})
    if refused:
        raise typer.Exit(2)
