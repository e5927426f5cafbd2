"""`derender decompose` and `mesh`: each image as its factors, and as a surface for other programs."""

from functools import partial

from derender.cli.options import ImageFiles, ImageModel, ImageOutput, command, option
from derender.report.options import MESH_FORMATS, MESH_SIZE, TEXTURE_SIZE, ImageOptions
from derender.storage.places import require_known


@command("decompose", "decompose --model runs/faces me.jpg you.png --out apart/")
def decompose(
    files: ImageFiles, model: ImageModel, how: ImageOptions, output: ImageOutput,
    sheet: bool = option(False, "Also draw all images below each other as sheet.png.", "--sheet"),
) -> None:  # fmt: skip
    """Write a folder per image: panel.png, one PNG per factor, scene.json and scene.npz."""
    from derender.report.decomposition import decomposed

    opener = model.opener(how, default_detail="model")
    files.edit(opener, partial(decomposed, opener.model), output, sheet=sheet)


@command("mesh", "mesh --model runs/faces me.jpg --format glb --out meshes/")
def mesh(
    files: ImageFiles, model: ImageModel, how: ImageOptions, output: ImageOutput,
    form: str = option("glb", "glb, or obj with its .mtl and .png.", "--format", metavar="glb|obj"),
    grazing: float = option(85.0, "Angle in degrees beyond which the surface is cut off at its rim."),
) -> None:  # fmt: skip
    """Write a folder per image with its surface as a mesh: its pixels as texture, x right, y up."""
    require_known("format", form, MESH_FORMATS)
    from derender.report.mesh import image_mesh

    opener = model.opener(how, MESH_SIZE if how.detail == "model" else TEXTURE_SIZE)
    edit = partial(image_mesh, opener.model, grazing_deg=grazing, form=form)
    files.edit(opener, edit, output, sheet=False)
