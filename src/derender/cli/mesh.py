"""`derender mesh`: a textured mesh of each image, for Blender, three.js and other programs."""

from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli.gathered import gathered
from derender.cli.images import ImageFiles, opener_of
from derender.cli.options import Output, TrainedModel
from derender.report.opening import MESH_SIZE, TEXTURE_SIZE, ImageOptions, OpenedImage

if TYPE_CHECKING:
    from derender.report.mesh import MeshFiles


def register(app: typer.Typer) -> None:
    app.command("mesh", epilog="Example: derender mesh --model runs/faces me.jpg --format glb --out meshes/")(
        mesh
    )


@gathered
def mesh(
    files: ImageFiles,
    model: TrainedModel,
    how: ImageOptions,
    output: Output,
    form: Annotated[
        str, typer.Option("--format", help="glb, or obj with its .mtl and .png.", metavar="glb|obj")
    ] = "glb",
    grazing: Annotated[
        float,
        typer.Option("--grazing", help="Angle in degrees beyond which the surface is cut off at its rim."),
    ] = 85.0,
) -> None:
    """Write a folder per image with its surface as a mesh: its pixels as texture, x right, y up."""
    from derender.report.mesh import MeshFiles, checked_format, image_mesh

    checked_format(form)
    opener = opener_of(model, how, MESH_SIZE if how.detail == "model" else TEXTURE_SIZE)

    def edit(image: OpenedImage) -> "MeshFiles":
        return MeshFiles(image_mesh(opener.model, image, grazing), form)

    files.edit(opener, edit, output, sheet=False)
