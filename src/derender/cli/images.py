"""Files, output and notes of the image commands: decompose, relight, rotate, swap, mesh.

How an image is read and drawn is in report/options.py; a new option of all these commands is one field there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli.console import notice, progress_bar
from derender.cli.options import OutFolder, Output, TrainedModel
from derender.report.options import ImageOptions
from derender.storage.places import require_image

if TYPE_CHECKING:
    from derender.photo.video import Edit as VideoEdit
    from derender.report.editing import Edited
    from derender.report.opening import ImageOpener, OpenedImage


@dataclass(frozen=True)
class ImageFiles:
    """Image files, and the folder for what is made of them."""

    images: Annotated[
        list[Path], typer.Argument(help="Image files, videos, or folders of them.", metavar="IMAGE...")
    ]
    out: OutFolder
    resume: Annotated[bool, typer.Option("--resume", help="Leave out images that are done.")] = False

    def __post_init__(self) -> None:
        require_image(self.images)

    def edit(
        self,
        opener: "ImageOpener",
        edit: "Callable[[OpenedImage], Edited]",
        output: Output,
        *,
        sheet: bool | None = None,
        beside: "Sequence[OpenedImage]" = (),
        video: "VideoEdit | None" = None,
    ) -> None:
        """Edit and write every image and report it; exit code 2 where one that was named cannot be read."""
        from derender.report.editing import write_images

        with progress_bar("drawing", "images") as report:
            written = write_images(
                opener, self.images, self.out, edit,
                force=output.force, resume=self.resume, sheet=sheet, beside=beside, video=video,
                progress=report,
            )  # fmt: skip
        for note in written.notes():
            notice(note)
        count = len(written.images)
        output.result(f"{count:,} image{'s' if count != 1 else ''} in {self.out}")
        output.write(written.values())
        if set(written.refused) & {str(path) for path in self.images}:  # of a folder others were used
            raise typer.Exit(2)


def opener_of(model: TrainedModel, how: ImageOptions, default_size: int = 0, **more: Any) -> "ImageOpener":
    """What opens images: the loaded model with the options."""
    from derender.report.opening import ImageOpener, held_out_errors

    held_out = held_out_errors(model.model)
    return ImageOpener(model.open(), how, default_size=default_size, held_out=held_out, **more)
