"""`derender relight`, `rotate`, `swap`: images in other light, from other sides, with factors of another."""

from functools import partial
from pathlib import Path
from typing import Any

from derender.cli.options import ImageFiles, ImageModel, ImageOutput, command, option
from derender.report.options import EDIT_SIZE, FilmOptions, ImageOptions

FACTOR = "Factor to take; may be repeated. By default each in turn."


@command("relight", "relight --model runs/faces me.jpg --like sunset.jpg --out relit/")
def relight(
    files: ImageFiles, model: ImageModel, how: ImageOptions, output: ImageOutput, film: FilmOptions,
    like: Path | None = option(None, "Go to the lighting of this image.", metavar="IMAGE"),
    reach: float = option(60.0, "Reach to either side, in degrees; a single file shows the light there."),
    pitch: float = option(10.0, "Height of the light, in degrees."),
    strength: float = option(1.0, "Strength in multiples of the image's own.", min=0, max=10),
) -> None:  # fmt: skip
    """Write strips and films of images under other lighting: from right to left, or to that of --like.

    A light is relative to the object, not to the camera: it falls on the same side of every face. Going
    round, it is as strong as the image's own, a third of it ambient.
    """
    from derender.report.edits import relit, relit_video

    opener = model.opener(how, EDIT_SIZE, whole=True)
    donor = None if like is None else opener.open(like)
    moves: dict[str, Any] = {"reach_deg": reach, "pitch_deg": pitch, "strength": strength, "like": donor}
    edit = partial(relit, opener.model, **moves, film=film.single(files.suffix))
    video = partial(relit_video, **moves, hold=film.hold)
    files.edit(opener, edit, output, beside=[donor] if donor else [], video=video)


@command("rotate", "rotate --model runs/faces me.jpg --reach 45 --out rotated/")
def rotate(
    files: ImageFiles, model: ImageModel, how: ImageOptions, output: ImageOutput, film: FilmOptions,
    reach: float = option(40.0, "Rotation to either side, in degrees; a single file shows it."),
    pitch: float = option(0.0, "Nod in degrees: the top comes forward."),
) -> None:  # fmt: skip
    """Write strips and films of images rotated from one side to the other, in their own lighting."""
    from derender.report.edits import rotated, rotated_video

    opener = model.opener(how, EDIT_SIZE, whole=True)
    moves = {"reach_deg": reach, "pitch_deg": pitch}
    edit = partial(rotated, opener.model, **moves, film=film.single(files.suffix))
    files.edit(opener, edit, output, video=partial(rotated_video, **moves, hold=film.hold))


@command("swap", "swap --model runs/faces me.jpg --from you.jpg --factor albedo --out mixed/")
def swap(
    files: ImageFiles, model: ImageModel, how: ImageOptions, output: ImageOutput,
    source: Path = option(..., "Image to take from.", "--from", metavar="IMAGE"),
    factor: list[str] | None = option(None, FACTOR, metavar="NAME"),
) -> None:  # fmt: skip
    """Write images with one factor of another: its geometry, albedo, light or camera, each by itself."""
    from derender.photo import is_video
    from derender.report.edits import swappable, swapped_factors, swapped_video
    from derender.report.opening import image_files

    opener = model.opener(how, EDIT_SIZE, whole=True)
    parameters = swappable(opener.model, factor or ())
    if files.suffix and len(parameters) > 1:
        raise ValueError(f"{files.out} is a single file, which shows one factor: add --factor NAME")
    donor = opener.open(source)
    edit = partial(swapped_factors, opener.model, donor=donor, factors=list(parameters))
    moving = any(is_video(path) for path in image_files(files.images, files.out))
    video = swapped_video(list(parameters.values()), donor) if moving else None
    files.edit(opener, edit, output, beside=[donor], video=video)
