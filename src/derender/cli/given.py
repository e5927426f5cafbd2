"""What the commands that take pictures by name share: reading them, where their folders lie, finer scenes.

A picture that cannot be read is left out and named at the end (exit code 2); the others are done. One that is
unlike what the model was validated on is done too, and named. With ``--frame auto`` a picture is the part of
the file that the model renders again best (scene/crop_search.py), wherever it is read.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli.console import notice, result, write_json

if TYPE_CHECKING:
    import numpy as np

    from derender.model import Derenderer
    from derender.scene import Scene
    from derender.scene.crop_search import Crop

PictureFiles = Annotated[list[Path], typer.Argument(help="Pictures to take apart.", metavar="IMAGE...")]
Size = Annotated[
    int,
    typer.Option("--size", min=8, max=4096, metavar="N", help="Side of what is drawn, in pixels."),
]
OwnSize = Annotated[
    int | None,
    typer.Option(
        "--size", min=8, max=4096, metavar="N", help="Side of what is drawn and written; else the model's."
    ),
]  # fmt: skip
Texture = Annotated[
    str,
    typer.Option(
        "--texture", help="model: its albedo. original: the picture's own detail where it shows.",
        metavar="model|original",
    ),
]  # fmt: skip
Frame = Annotated[
    str,
    typer.Option(
        "--frame", help="auto: the part of each picture that the model renders again best.",
        metavar="whole|auto",
    ),
]  # fmt: skip
TEXTURES = ("model", "original")
FRAMES = ("whole", "auto")
PIXELS_AT_ONCE = 1 << 22


@dataclass(frozen=True)
class Given:
    """Pictures that were named.

    Attributes:
        pictures: those that can be read, (3, S, S) at the model's size, by path.
        folders: where each goes.
        refused: reasons why the others cannot be read, by path.
    """

    pictures: "Mapping[Path, np.ndarray]"
    folders: list[Path]
    refused: Mapping[Path, str]


def check_frame(frame: str) -> bool:
    """Whether pictures are to be framed; an unknown word is an error that names the known ones."""
    from derender.data import suggestion

    if frame not in FRAMES:
        raise ValueError(
            f"unknown --frame {frame!r}{suggestion(frame, FRAMES)}: choose {' or '.join(FRAMES)}"
        )
    return frame == "auto"


class PictureReader:
    """Pictures by name, each whole or, with ``auto``, the part of it that a model renders again best.

    Attributes:
        net: the model.
        framings: the part of every picture looked at so far.
    """

    def __init__(self, net: "Derenderer", frame: str = "whole"):
        self.net, self.auto = net, check_frame(frame)
        self.framings: dict[Path, Crop] = {}

    def __call__(self, path: Path, size: int) -> "np.ndarray":
        """(3, size, size) uint8; a file that is no picture is a ValueError or OSError that says so."""
        return self._framed(path, size) if self.auto else one_picture(path, size)

    def _framed(self, path: Path, size: int) -> "np.ndarray":
        import torch

        from derender.scene.crop_search import SEARCH_SCALE, as_bytes, best_crops

        if path not in self.framings:
            looked_at = torch.from_numpy(one_picture(path, SEARCH_SCALE * self.net.image_size)[None])
            (self.framings[path],) = best_crops(self.net, looked_at)
        framing = self.framings[path]
        larger = torch.from_numpy(one_picture(path, round(size / framing.side))[None])
        return as_bytes(framing.cut(larger, size))[0].numpy()


def given_pictures(
    images: Sequence[Path], read: PictureReader, out: Path, force: bool, *, sheet: bool = True
) -> Given:
    """Read the pictures, and refuse to write over what an earlier command left."""
    from derender.report.files import folder_names
    from derender.report.sheets import sheet_paths

    readable: dict[Path, Any] = {}
    refused: dict[Path, str] = {}
    for path in dict.fromkeys(images):
        try:
            readable[path] = read(path, read.net.image_size)
        except (ValueError, OSError) as problem:
            refused[path] = " ".join(str(problem).split())
    if not readable:
        raise ValueError(next(iter(refused.values())))
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"{out} is a file: give --out the name of a folder")
    folders = folder_names(list(readable), out)
    files = sheet_paths(out, len(folders)) if sheet and len(folders) > 1 else []
    taken = [place for place in (*folders, *files) if place.exists()]
    if taken and not force:
        raise FileExistsError(
            f"{taken[0]} exists already: choose another --out, or add --force to replace it"
        )
    return Given(readable, folders, refused)


def one_picture(path: Path, size: int) -> "np.ndarray":
    """One picture; a path that leads nowhere is an error that says so."""
    from derender.data import nearest_sibling, read_picture

    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist{nearest_sibling(path)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name pictures, such as {path / '*.jpg'}")
    return read_picture(path, size)


def scenes_of(net: "Derenderer", given: Given, batch_size: int) -> "list[Scene]":
    """The scene of every picture, on the model's device."""
    import numpy as np

    from derender.features import map_batches

    stacked = np.stack(list(given.pictures.values()))
    batches = map_batches(net.decompose, net, stacked, batch_size=batch_size)
    return [batch[row] for batch in batches for row in range(len(batch))]


def refining(
    read: PictureReader,
    size: int | None,
    texture: str,
    fit_steps: int | None = None,
    source: str = "this model",
) -> "Callable[[Scene, Sequence[Path]], Scene] | None":
    """What makes scenes finer: fits, enlarges, takes albedo from the pictures; None for none of it."""
    from derender.cli.models import fitting_of
    from derender.data import as_float, suggestion
    from derender.report.texture import picture_albedo, picture_on_grid
    from derender.scene.enlarge import at_size

    net = read.net
    if texture not in TEXTURES:
        raise ValueError(
            f"unknown texture {texture!r}{suggestion(texture, TEXTURES)}: choose {' or '.join(TEXTURES)}"
        )
    side = net.image_size if size is None else size
    if side < net.image_size:
        raise ValueError(f"--size {side} is below the model's {net.image_size}: give that or more")
    fitting = fitting_of(net, source) if fit_steps else None
    if side == net.image_size and texture == "model" and fitting is None:
        return None

    def refine(scene: "Scene", sources: Sequence[Path]) -> "Scene":
        import numpy as np

        if fitting is not None:
            own = as_float(np.stack([read(path, net.image_size) for path in sources])).to(scene.depth)
            scene = fitting.fit(own, scene, net.render, fit_steps).scene
        scene = at_size(scene, side)
        if texture == "model":
            return scene
        pixels = as_float(np.stack([read(path, side) for path in sources])).to(scene.depth)
        if side != net.image_size:
            pixels = picture_on_grid(pixels, net.image_size)
        return scene.with_parameters(albedo=picture_albedo(pixels, scene, net.fov_deg))

    return refine


def batch_that_fits(batch_size: int, size: int | None) -> int:
    """Fewer pictures at a time where each is large."""
    return batch_size if size is None else max(1, min(batch_size, PIXELS_AT_ONCE // size**2))


def percentiles(source: str, net: "Derenderer", pictures: "Mapping[Path, np.ndarray]") -> dict[Path, float]:
    """Each picture's reconstruction percentile; empty where the model has nothing to compare with.

    It only informs: a file that is damaged is told and passed over.
    """
    import numpy as np

    from derender.evaluation.out_of_distribution import reconstruction_percentile
    from derender.model import model_folder
    from derender.training.held_out_errors import read_errors

    try:
        held_out = read_errors(model_folder(source))
    except (ValueError, OSError) as problem:
        notice(f"cannot tell odd pictures: {problem}")
        return {}
    if held_out is None:
        return {}
    found = reconstruction_percentile(net, np.stack(list(pictures.values())), held_out)
    return dict(zip(pictures, found.tolist(), strict=True))


def tell_odd(found: Mapping[Path, float], framed: bool = False) -> None:
    """Name every picture that the model renders again worse than nearly all it was validated on."""
    from derender.evaluation.out_of_distribution import OUTLIER_PERCENTILE

    hint = "" if framed else ", or not as it knows it (--frame auto looks for the part that it knows)"
    for path, percentile in found.items():
        if percentile > OUTLIER_PERCENTILE:
            notice(
                f"{path}: reconstructed worse than {OUTLIER_PERCENTILE:g} % of the pictures this model was "
                f"validated on; it may not be what the model knows{hint}"
            )


def tell_percentiles(found: Mapping[Path, float]) -> None:
    """Say where the pictures lie among those the model was validated on; nothing where that is not known."""
    if found:
        low, high = round(min(found.values())), round(max(found.values()))
        span = f"{low}" if low == high else f"{low} to {high}"
        notice(f"rendered again worse than {span} % of the pictures this model was validated on")


def finish(
    given: Given,
    read: PictureReader,
    out: Path,
    written: Sequence[Any],
    json_file: str | None,
    odd: Mapping[Path, float] | None = None,
    **more: Any,
) -> None:
    """Name what was left out or is odd, say what was done, write the JSON; exit code 2 if one was left out.

    ``odd`` has the reconstruction percentile of each picture.
    """
    for path, reason in given.refused.items():
        notice(f"left out {path}: {reason}")
    tell_percentiles(odd or {})
    tell_odd(odd or {}, read.auto)
    count = "1 picture" if len(written) == 1 else f"{len(written):,} pictures"
    result(f"{count} in {out}", json_file)
    told: dict[str, Any] = {
        "reconstruction_percentile": {str(path): value for path, value in (odd or {}).items()}
    }
    if read.auto:
        told["framing"] = {str(path): asdict(framing) for path, framing in read.framings.items()}
        notice(_framed_account(read))
    write_json(json_file, {"out": out, "pictures": written, "refused": given.refused, **told, **more})
    if given.refused:
        raise typer.Exit(2)


def _framed_account(read: PictureReader) -> str:
    """How many pictures are shown in part, and how small the parts are."""
    from derender.scene.crop_search import WHOLE

    sides = [framing.side for framing in read.framings.values() if framing != WHOLE]
    if not sides:
        return "every picture is shown whole: no part of any is rendered again clearly better"
    low, high = round(100 * min(sides)), round(100 * max(sides))
    span = f"{low} %" if low == high else f"{low} to {high} %"
    return f"shown in part, {span} of their side: {len(sides):,} of {len(read.framings):,} pictures"
