"""`derender import`: an unsup3d checkpoint as a derender model."""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli.console import notice
from derender.cli.options import OutModel, Output, Settings, command, option

PRESETS = ("faces", "cats", "cars")
Checkpoint = Annotated[Path, typer.Argument(help="The .pth file that unsup3d wrote.", metavar="CHECKPOINT")]


@command("import", "import unsup3d.pth --preset faces --out imported/")
def import_checkpoint(
    checkpoint: Checkpoint, out: OutModel, output: Output,
    preset: str = option("faces", f"Kind of object it was trained on: {', '.join(PRESETS)}."),
    settings: Settings = None,
) -> None:  # fmt: skip
    """Write a derender model with the weights of an unsup3d checkpoint. Nothing in the file is run.

    With --set the ranges of its training are given where they differ, as translation_z=0.1 or fov_deg=10.
    """
    output.check(out, folder=True)
    from derender.model import Derenderer
    from derender.networks.unsup3d import NETS
    from derender.presets import MODEL_PRESETS, named_preset
    from derender.training.config import with_changes

    ranges = named_preset(preset, {name: MODEL_PRESETS[name] for name in PRESETS}).ranges
    model = Derenderer.from_unsup3d(checkpoint, with_changes(ranges, settings or []))
    folder = model.save_pretrained(
        out, licence="that of the checkpoint", scores="No score was measured since it was imported.",
        data=f"the training set of {checkpoint.name}: a checkpoint of unsup3d, imported, not trained further",
        overwrite=output.force,
    )  # fmt: skip
    counts = {name: sum(value.numel() for value in model.nets[name].parameters()) for name in NETS.values()}
    how = f"derender evaluate reconstruction IMAGES --model {folder}"
    size = f"{model.image_size} x {model.image_size} pixels, {sum(counts.values()):,} parameters"
    notice(f"{size}; measure how well it reconstructs your images: {how}")
    output.result(f"model {folder}")
    output.write({"model": folder, "numbers": counts, "image_size": model.image_size})
