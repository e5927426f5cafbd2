"""Edit images and write the results: what the image commands do, as one library call.

An edit makes of an opened image what is written for it: a ``Decomposition``, an ``Edit`` (relit, rotated,
swapped) or a ``Mesh``. Each image has a folder, which appears whole or not at all. An image that cannot be
read is left out and listed; the others are written. Leaves out opening (``opening``) and the edits
(``decomposition``, ``edits``, ``mesh``).
"""

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from PIL import Image

from derender.photo import edit_video, is_video
from derender.photo.faces import TEMPLATES
from derender.photo.video import Edit as VideoEdit
from derender.report.colours import enlarged
from derender.report.opening import ImageOpener, OpenedImage, image_files, readable
from derender.report.options import STILL_SUFFIXES
from derender.report.panel import ROWS_PER_SHEET, SHEET, row_sheets
from derender.storage.atomic import atomic_file, atomic_folder
from derender.storage.places import counted
from derender.training.held_out_errors import OUTLIER_PERCENTILE, fitting_better, unlike
from derender.training.process import locked

if TYPE_CHECKING:  # their imports take long
    from derender.report.decomposition import Decomposition
    from derender.report.edits import Edit
    from derender.report.mesh import Mesh

FILM = "film.mp4"
ROWS = ".sheet"  # folder of the rows of a sheet, a file for each image, until the sheet is drawn
NAMED = 5  # so many images that cannot be read are named

Edited: TypeAlias = "Decomposition | Edit | Mesh"  # has files to ``write``, and a ``row`` of the sheet


@dataclass(frozen=True)
class WrittenImages:
    """What ``write_images`` made."""

    out: Path  # the folder
    images: Sequence[dict[str, Any]]  # a record for each image, as its JSON file holds it
    sheets: Sequence[Path]  # files with a row for every image
    refused: Mapping[Path, str]  # reasons why other images cannot be read, by path
    # of the reconstruction errors, by path; empty where the model keeps none
    percentiles: Mapping[Path, float]
    # the part of each image that is shown, and how it was found, by path
    framing: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)
    unlike: str = ""  # how images differ from those the model was validated on (``held_out_errors.unlike``)
    before: int = 0  # number of images that were left out, for their folders were there
    help: str = ""  # what to do with those that do not suit the model

    def notes(self) -> list[str]:
        """Lines for a person: what was left out, what is out-of-distribution, what was cropped."""
        reasons = {path: why.removeprefix(str(path)).lstrip() for path, why in self.refused.items()}
        lines = [f"left out {path}: {why}" for path, why in reasons.items()]
        if (more := len(lines) - NAMED) > 0:
            lines[NAMED:] = [f"and {more:,} more (--json names all)"]
        if self.help:
            lines.append(f"for those that do not suit the model: {self.help}")
        if self.before:
            lines.append(f"{self.before:,} done before")
        if self.percentiles and not self.unlike:
            span = _span(self.percentiles.values())
            lines.append(f"reconstructed worse than {span} % of the images this model was validated on")
        if self.unlike:
            first = next(path for path, at in self.percentiles.items() if at > OUTLIER_PERCENTILE)
            lines.append(f"{self.unlike}; {first} is one")
        result = Counter(part["found"] for part in self.framing.values())
        faces = result["face"] + result["profile"]
        if result.total() > 1 and (faces or result["no face"]):
            lines.append(f"a face was found in {faces:,} of {result.total():,} images")
        if doubts := {path: part["doubt"] for path, part in self.framing.items() if "doubt" in part}:
            path, doubt = next(iter(doubts.items()))
            lines.append(f"drawn all the same: {counted(len(doubts), 'images')}, as {path}: {doubt}")
        if result["auto"]:
            sides = [100 * part["side"] for part in self.framing.values() if part["side"] < 1]
            share = f", {_span(sides)} % of their side" if sides else ""
            lines.append(f"shown in part{share}: {len(sides):,} of {counted(result['auto'], 'images')}")
        return lines

    def values(self) -> dict[str, Any]:
        """All of it as JSON can hold it; keys are paths, for a name may be no UTF-8."""
        return {
            "out": self.out,
            "pictures": self.images,
            "refused": self.refused,
            "reconstruction_percentile": self.percentiles,
            "framing": self.framing,
            "sheets": self.sheets,
        }


def write_images(
    opener: ImageOpener, paths: Sequence[Path], out: Path, edit: Callable[[OpenedImage], Edited], *,
    force: bool = False, sheet: bool | None = None, beside: Sequence[OpenedImage] = (),
    resume: bool = False, video: VideoEdit | None = None, progress: Callable[..., object],
) -> WrittenImages:  # fmt: skip
    """Edit images, and write a folder for each.

    Args:
        opener: a model and how images are read and drawn.
        paths: image files, videos, and folders of them.
        out: folder of the folders.
        edit: makes of an opened image what is written.
        force: replace what is there, and draw images that do not suit the model.
        sheet: also draw a row for every image as sheet.png; by default for two images or more. With
            ``resume`` it shows those of the interrupted run, too; none is drawn where a row is missing.
        beside: images that the edit takes something from; percentiles and crops list them, too.
        resume: leave out images whose folders are there already.
        video: what is done to videos; None refuses them.
        progress: called with (images done, images in all), and what is being done as ``description``.

    Raises:
        FileExistsError: something would be replaced, and ``force`` is off.
        ValueError: no image can be read or suits the model, the edit is impossible, or another process writes
            to ``out``.
    """
    files, how = image_files(paths, out), opener.options
    places, kept = _places(files, out), out / ROWS
    done = {file for file in files if resume and places[file].exists()}
    files = [file for file in files if file not in done]
    if not files and not kept.exists():
        return WrittenImages(out, [], [], {}, {}, before=len(places))
    moving = [file for file in files if is_video(file)]
    if moving and video is None:
        raise ValueError(f"{moving[0]} is a video: relight, rotate or swap it")
    unused = {"only_frame": how.only_frame, "size": how.size, "detail=model": opener.detail == "model"}
    if moving and moving == files and (given := [name for name, value in unused.items() if value]):
        raise ValueError(f"{moving[0]} is a video, which is drawn whole: leave out {', '.join(given)}")
    needed = not moving and not done
    read, refused = readable([file for file in files if file not in moving], opener.read, progress, needed)
    doubts, help = {} if force else opener.unsuitable(read), ""
    if doubts:
        better = fitting_better(np.stack([read.pop(path)[0] for path in doubts]), TEMPLATES)
        help = f"{better}{better and '; '}--frame auto looks for another part, --force draws all"
        if needed and not read:
            path, doubt = next(iter(doubts.items()))
            raise ValueError(f"{path}: {doubt}; {help}")
    refused |= doubts
    with_row = [file for file in places if file in read or (file in done and not is_video(file))]
    shown = {file: kept / f"{places[file].name}.npz" for file in with_row}
    with_sheet = len(shown) > 1 if sheet is None else sheet
    with_sheet &= all(row.exists() for file, row in shown.items() if file in done)
    records: list[dict[str, Any]] = []
    _require_free([places[path] for path in (*read, *moving)], out, with_sheet, force or resume)
    with _alone(out):
        images = opener.decomposed(read) if read else []
        for image in images:
            made, folder = edit(opener.finer(image)), places[image.path]
            if with_sheet:
                cells = {name: np.asarray(enlarged(one, SHEET.cell)) for name, one in made.row.items()}
                with atomic_file(shown[image.path]) as temporary, temporary.open("wb") as stream:
                    np.savez(stream, allow_pickle=False, **cells)
            with atomic_folder(folder) as temporary:
                records.append(made.write(temporary, {"picture": str(image.path), "folder": str(folder)}))
            progress(len(records), len(images), description="drawing")

        def filmed(path: Path) -> dict[str, Any]:
            assert video is not None
            with atomic_folder(places[path]) as temporary:
                film = edit_video(
                    path, temporary / FILM, opener.model, video, frame=how.frame, fit_steps=how.fit_steps,
                    progress=progress,
                )  # fmt: skip
                record = {"picture": str(path), "folder": str(places[path]), **vars(film), "out": FILM}
                (temporary / "moved.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
            return record

        films, failed = readable(moving, filmed, needed=False)
        records, refused = [*records, *films.values()], refused | failed
        if refused and not records and not done:
            raise ValueError(next(iter(refused.values())))
        rows = [(file.name, _row(row)) for file, row in shown.items()] if with_sheet else []
        rows = [row for row in rows if row[1]]
        files = _sheet_files(out, len(rows))
        for file, drawn in zip(files, row_sheets(rows), strict=True):
            with atomic_file(file) as temporary:
                drawn.save(temporary, format="PNG")
        shutil.rmtree(kept, ignore_errors=True)
    every = [*images, *beside]
    percentiles = {one.path: one.percentile for one in every if one.percentile is not None}
    framing = {one.path: one.framing for one in every}
    odd = ""
    if percentiles:
        odd = unlike(np.stack([one.pixels for one in every]), [one.percentile or 0 for one in every])
    before = len(places) - len(records) - len(refused)
    return WrittenImages(out, records, files, refused, percentiles, framing, odd, before, help)


def write_image_file(
    opener: ImageOpener, paths: Sequence[Path], out: Path, edit: Callable[[OpenedImage], Edited], *,
    force: bool = False, resume: bool = False, **how: Any,
) -> WrittenImages:  # fmt: skip
    """Edit one image, and write a single file of that: the last still, a film, a panel or a mesh.

    ``out`` names the file, its suffix the kind; other arguments and errors as for ``write_images``.

    Raises:
        ValueError: there are several images, or the edit makes no such file.
    """
    image, *more = image_files(paths, out)
    if more:
        raise ValueError(f"{out} is a single file, and there are {1 + len(more):,} images: name a folder")
    if out.resolve() == image.resolve():
        raise ValueError(f"{out} is the image itself: name another file as --out")
    if out.exists() and resume:
        return WrittenImages(out, [], [], {}, {}, before=1)
    _require_free([out], out.parent, False, force)
    with tempfile.TemporaryDirectory() as folder, atomic_file(out) as temporary:
        how = {**how, "force": force, "sheet": False}
        written = write_images(opener, [image], Path(folder) / "images", edit, **how)
        record = written.images[0]
        _copy_single(Path(record["folder"]), temporary, out)
    elsewhere = ("folder", "files", "stills", "out")  # of the record: files that are gone
    record = {name: value for name, value in record.items() if name not in elsewhere}
    return replace(written, out=out, images=[{**record, "file": str(out)}])


def _copy_single(folder: Path, temporary: Path, out: Path) -> None:
    """Copy the one of an image's files that ``out`` asks for by its suffix."""
    suffix = out.suffix.lower()
    names = ("panel.png", "still-*.png") if suffix in STILL_SUFFIXES else (f"film{suffix}", f"*{suffix}")
    files = [file for name in names for file in sorted(folder.glob(name))]
    if not files or suffix == ".obj":
        kinds = sorted({file.suffix for file in folder.iterdir()} & {".png", ".gif", ".mp4", ".glb"})
        raise ValueError(f"{out}: no single {suffix} is made here, but {' or '.join(kinds) or 'a folder'}")
    if suffix in STILL_SUFFIXES:
        kind = Image.registered_extensions()[suffix]
        with Image.open(files[-1]) as still:
            (still.convert("RGB") if kind == "JPEG" else still).save(temporary, format=kind, quality=95)
    else:
        shutil.copyfile(files[0], temporary)


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Keep other processes from writing images to a folder; it goes again if it was made and stays empty."""
    made = not out.exists()
    try:
        with locked(out / ROWS):
            yield
    finally:
        if made:
            with suppress(OSError):  # it has files, as a rule
                out.rmdir()


def _row(file: Path) -> dict[str, Image.Image]:
    """The cells of a sheet's row by their names."""
    with np.load(file, allow_pickle=False) as cells:
        return {name: Image.fromarray(cells[name]) for name in cells.files}


def _places(images: Sequence[Path], out: Path) -> dict[Path, Path]:
    """A folder in ``out`` for each image, named after it."""
    names: dict[str, Path] = {}
    for image in images:
        name, number = image.stem or "picture", 2
        while name.casefold() in names:
            name, number = f"{image.stem}-{number}", number + 1
        names[name.casefold()] = out / name
    return dict(zip(images, names.values(), strict=True))


def _require_free(folders: Sequence[Path], out: Path, sheet: bool, force: bool) -> None:
    """What is there already is an error, unless ``force`` allows it."""
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"{out} is a file: name a folder to write to")
    sheets = _sheet_files(out, len(folders)) if sheet else []
    existing = [place for place in (*folders, *sheets) if place.exists()]
    if existing and not force:
        fix = "choose another --out, or add --force to replace it"
        raise FileExistsError(f"{existing[0]} exists already: {fix}")


def _sheet_files(out: Path, count: int) -> list[Path]:
    """``sheet.png``, or ``sheet-1.png`` and so on where the rows fill several."""
    number = -(-count // ROWS_PER_SHEET)
    return [out / ("sheet.png" if number == 1 else f"sheet-{index}.png") for index in range(1, number + 1)]


def _span(values: Iterable[float]) -> str:
    """The lowest and highest of some numbers, rounded."""
    rounded = sorted(round(value) for value in values)
    return f"{rounded[0]}" if rounded[0] == rounded[-1] else f"{rounded[0]} to {rounded[-1]}"
