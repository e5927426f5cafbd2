"""`derender mesh`: a textured mesh of each picture, for Blender, three.js and other programs."""

from math import ceil
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import progress_bar
from derender.cli.given import (
    Frame,
    PictureFiles,
    PictureReader,
    Size,
    Texture,
    finish,
    given_pictures,
    percentiles,
    refining,
    scenes_of,
)

DEFAULT_SIZE = 128


def register(app: typer.Typer) -> None:
    app.command("mesh", epilog="Example: derender mesh --model runs/faces me.jpg --format glb --out meshes/")(
        mesh
    )


def mesh(
    images: PictureFiles,
    model: options.Model,
    out: options.OutFolder,
    form: Annotated[
        str, typer.Option("--format", help="glb, or obj with its .mtl and .png.", metavar="glb|obj")
    ] = "glb",
    size: Size = DEFAULT_SIZE,
    texture: Texture = "model",
    fit_steps: options.FitSteps = None,
    frame: Frame = "whole",
    grazing: Annotated[
        float,
        typer.Option(
            "--grazing", help="Cut the rim off where it is turned further from the viewer, in degrees."
        ),
    ] = 85.0,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a folder per picture with its surface as a mesh: albedo as texture, x right, y up, facing +z."""
    from derender.cli.models import open_model
    from derender.report.mesh import mesh_of
    from derender.report.mesh_files import checked_format, mesh_files
    from derender.storage.atomic import atomic_folder

    checked_format(form)
    if not 0 < grazing <= 90:
        raise ValueError(f"--grazing must lie above 0 and up to 90 degrees, got {grazing:g}")
    net = open_model(model, device)
    read = PictureReader(net, frame)
    refine = refining(read, size, texture, fit_steps, model)
    given = given_pictures(images, read, out, force, sheet=False)
    border = _border(net.settings.ranges.border_columns(net.image_size), net.image_size, size)
    written = []
    with progress_bar("meshing") as report:
        for scene, folder, path in zip(scenes_of(net, given, 64), given.folders, given.pictures, strict=True):
            finer = scene if refine is None else refine(scene, [path])
            made = mesh_of(finer, net.fov_deg, border, grazing)
            with atomic_folder(folder) as temporary:
                files = mesh_files(made, folder.name, form)
                for name, content in files.items():
                    (temporary / name).write_bytes(content)
            written.append(
                {
                    "picture": path,
                    "files": [folder / name for name in files],
                    "vertices": len(made.vertices),
                    "faces": len(made.faces),
                    "trimmed": made.trimmed,
                }
            )
            report(len(written), len(given.folders))
    finish(given, read, out, written, json_file, percentiles(model, net, given.pictures))


def _border(columns: int, model_size: int, size: int) -> int:
    """Columns of an enlarged scene the model's border reaches: enlarging smooths its step over one more."""
    if not columns or size == model_size:
        return columns
    return ceil((columns + 1) * (size - 1) / (model_size - 1))
