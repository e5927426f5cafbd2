"""`derender decompose` and `mesh`: each image as its factors, and as a surface for other programs."""

from functools import partial
from typing import TYPE_CHECKING, Annotated

from typer import Option

from derender.cli.gathered import command
from derender.cli.images import ImageFiles, opener_of
from derender.cli.options import Output, TrainedModel
from derender.report.opening import MESH_FORMATS, MESH_SIZE, TEXTURE_SIZE, ImageOptions, OpenedImage
from derender.storage.places import require_known

if TYPE_CHECKING:
    from derender.report.mesh import MeshFiles

Sheet = Annotated[bool, Option("--sheet", help="Also draw all images below each other as sheet.png.")]
Format = Annotated[str, Option("--format", help="glb, or obj with its .mtl and .png.", metavar="glb|obj")]
Grazing = Annotated[float, Option(help="Angle in degrees beyond which the surface is cut off at its rim.")]


@command("decompose", "decompose --model runs/faces me.jpg you.png --out apart/")
def decompose(
    files: ImageFiles, model: TrainedModel, how: ImageOptions, output: Output, sheet: Sheet = False
) -> None:
    """Write a folder per image: panel.png, one PNG per factor, scene.json and scene.npz."""
    from derender.report.decomposition import decomposed

    opener = opener_of(model, how, default_detail="model")
    files.edit(opener, partial(decomposed, opener.model), output, sheet=sheet)


@command("mesh", "mesh --model runs/faces me.jpg --format glb --out meshes/")
def mesh(
    files: ImageFiles, model: TrainedModel, how: ImageOptions, output: Output, form: Format = "glb",
    grazing: Grazing = 85.0,
) -> None:  # fmt: skip
    """Write a folder per image with its surface as a mesh: its pixels as texture, x right, y up."""
    require_known("format", form, MESH_FORMATS)
    from derender.report.mesh import MeshFiles, image_mesh

    opener = opener_of(model, how, MESH_SIZE if how.detail == "model" else TEXTURE_SIZE)

    def edit(image: OpenedImage) -> "MeshFiles":
        return MeshFiles(image_mesh(opener.model, image, grazing), form)

    files.edit(opener, edit, output, sheet=False)
