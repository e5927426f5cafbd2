"""The faces of many photographs, each cut out upright where a model expects it, with the way back.

``boxes.csv`` has a row for every box, accepted or rejected: where the crop lies, the affine transform from
its pixels to the photograph's, and the reason of a rejection. Photographs are read one after another; a
stopped run continues after the last photograph that it finished. Leaves out finding (``faces``).
"""

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from io import StringIO
from math import cos, radians, sin
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from derender.data import Stream, decode_whole, estimated_total, open_images, quiet_pillow
from derender.inputs import Progress, as_model
from derender.model import Derenderer
from derender.photo.faces import PROFILE_DEG, UTKFACE, Face, Template, face_candidates, frame_of, template_of
from derender.photo.frame import Frame
from derender.storage.atomic import atomic_file
from derender.storage.bounded import LINES_LIMIT_BYTES, first_line, parse_json, read_text
from derender.storage.places import counted
from derender.training import held_out_errors as errors

BOXES = "boxes.csv"
AFFINE = ("xx", "xy", "x0", "yx", "yy", "y0")
COLUMNS = (
    *("file", "photo", "rejected", "confidence", "left", "top", "right", "bottom"),
    *("x", "y", "side", "roll_deg", *AFFINE),
)
UNREADABLE = "cannot be read: "


@dataclass(frozen=True)
class Aligned:
    """What `align` wrote.

    Attributes:
        out: the folder of crops and ``boxes.csv``.
        rows: one for each box, and one for each photograph without any: ``COLUMNS`` by name, as text.
        resumed: photographs that an earlier run had finished.
    """

    out: Path
    rows: list[dict[str, str]]
    resumed: int

    @property
    def counts(self) -> dict[str, int]:
        """Photographs, faces, photographs without a face, rejected boxes, and unreadable files."""
        faces = [row for row in self.rows if row["file"] and not row["rejected"]]
        photos = {row["photo"] for row in self.rows}
        unreadable = sum(row["rejected"].startswith(UNREADABLE) for row in self.rows)
        return {
            "photographs": len(photos),
            "faces": len(faces),
            "without_face": len(photos) - len({row["photo"] for row in faces}) - unreadable,
            "rejected": sum(bool(row["rejected"] and row["left"]) for row in self.rows),
            "unreadable": unreadable,
        }

    def describe(self) -> str:
        """One line."""
        n = self.counts
        faces = f"{counted(n['faces'], 'faces')} in {counted(n['photographs'], 'photographs')}"
        rest = f"{n['rejected']:,} rejected, {n['unreadable']:,} unreadable ({BOXES} names each)"
        return f"{faces}; no face in {n['without_face']:,}, {rest}"


def align(
    photos: Stream | str | Path, out: str | Path, *, model: Derenderer | str | Path | None = None,
    size: int = 256, margin: float = 0.0, largest: bool = False, keep: bool = False, dataset: str = "auto",
    limit: int | None = None, overwrite: bool = False, progress: Progress | None = None,
) -> Aligned:  # fmt: skip
    """Cut every face of photographs out, upright, where UTKFace or a model of faces has it.

    Args:
        photos: a folder, zip, image, shards or Hugging Face id, or an open stream.
        out: folder for the crops (PNG, in the folders of their photographs) and ``boxes.csv``.
        model: cut as it was trained; a crop that it reconstructs worse than 99 % of its held-out images is
            rejected.
        size: side of the crops in pixels.
        margin: more of the surroundings on every side, in shares of the side.
        largest: only the largest face of each photograph.
        keep: of photographs without a face, write the middle square.
        dataset, limit: how the photographs are read.
        overwrite: replace what an earlier run made; without, a stopped run is continued.
        progress: called with (photographs done, in all).

    Raises:
        ValueError: the stopped run in ``out`` had other options, or the model is of no known faces.
        FileExistsError: ``out`` holds a finished run, or other files, which no run replaces.
    """
    if not (8 <= size <= 4096 and 0 <= margin <= 2):
        raise ValueError(f"size must be 8 to 4096 and margin 0 to 2, got {size} and {margin:g}")
    loaded = None if model is None else as_model(model)
    template = UTKFACE if loaded is None else template_of(loaded)
    if template is None:
        raise ValueError(f"{model} is not known to be of faces: choose faces-64, rendered-faces-64 or none")
    held_out = errors.read_errors(loaded.source) if loaded and loaded.source else None
    cutter = _Cutter(Path(out), size, margin, largest, keep, template, loaded, held_out)
    boxes, partial = cutter.out / BOXES, cutter.out / f"{BOXES}.partial"
    if boxes.exists() and not overwrite:
        raise FileExistsError(f"{boxes} exists already: choose another folder, or replace it (--force)")
    if not (boxes.exists() or partial.exists()) and any(one.name[0] != "." for one in cutter.out.glob("*")):
        raise FileExistsError(f"{cutter.out} holds other files: choose an empty or new folder")
    stream = open_images(photos, dataset=dataset, limit=limit) if not isinstance(photos, Stream) else photos
    if Path(stream.place).is_dir() and cutter.out.resolve().is_relative_to(Path(stream.place).resolve()):
        raise ValueError(f"{out} is among the photographs, so crops would be read as such: move it out")
    with stream:
        plan = {"photos": stream.place, "size": size, "margin": margin, "largest": largest, "limit": limit}
        plan |= {"keep": True} if keep else {}
        plan["model"] = None if model is None else str(getattr(model, "source", model))
        if overwrite:
            for row in [row for file in (boxes, partial) for row in _read(file)[1]]:
                crop = (cutter.out / row["file"]).resolve()
                if row["file"].endswith(".png") and crop.is_relative_to(cutter.out.resolve()):
                    crop.unlink(missing_ok=True)
        earlier, rows = (None, []) if overwrite else _read(partial)
        if earlier not in (None, plan):
            raise ValueError(f"{partial} was made with other options: give those, or begin anew (--force)")
        finished = {row["photo"] for row in rows}
        cutter.taken.update(row["file"].casefold() for row in rows)
        _write(partial, rows, plan)
        try:
            for number, sample in enumerate(stream.samples(), 1):
                if sample.file not in finished:
                    results = list(cutter.rows(sample.file, sample.read))
                    with partial.open("a", newline="", encoding="utf-8") as file:
                        csv.DictWriter(file, COLUMNS).writerows(results)
                    rows += results
                if progress is not None:
                    progress(number, estimated_total(number, sample.share, stream.limit))
                if number == stream.limit:
                    break
        except KeyboardInterrupt as stopped:
            count = len({row["photo"] for row in rows})
            stop = f"stopped by Ctrl-C; {count:,} photographs are done: the same command continues"
            raise KeyboardInterrupt(stop) from stopped
    done = Aligned(cutter.out, rows, len(finished))
    if done.counts["unreadable"] == done.counts["photographs"]:
        raise ValueError(f"none of the photographs can be read; {rows[0]['photo']}: {rows[0]['rejected']}")
    _write(boxes, rows)
    partial.unlink()
    return done


@dataclass(frozen=True)
class _Cutter:
    """Cuts the faces of photographs out, and writes them."""

    out: Path
    size: int
    margin: float
    largest: bool
    keep: bool
    template: Template
    model: Derenderer | None
    held_out: errors.HeldOutErrors | None
    taken: set[str] = field(default_factory=set)  # names of crops, in lower case

    def rows(self, photo: str, read: Callable[[], bytes]) -> Iterator[dict[str, str]]:
        """Write the crops of one photograph; rows for its boxes."""
        try:
            with quiet_pillow():
                pixels = decode_whole(read())
        except (ValueError, OSError) as problem:
            yield _row(photo, UNREADABLE + " ".join(str(problem).split()))
            return
        accepted = 0
        for face in face_candidates(pixels):
            frame = frame_of(face, self.template)
            rejected = face.rejected or self._doubt(pixels, face, frame)
            if not rejected and self.largest and accepted:
                rejected = "not the largest face"
            accepted += not rejected
            frame = replace(frame, side=frame.side * (1 + 2 * self.margin))
            file = "" if rejected else self._write(pixels, frame, photo, accepted)
            yield _row(photo, rejected, file, (face.confidence, *face.box), self._place(frame))
        if not accepted:
            middle = Frame.centred(pixels.shape[1], pixels.shape[0])
            file = self._write(pixels, middle, photo, 1) if self.keep else ""
            yield _row(photo, "no face found", file, place=self._place(middle) if self.keep else ())

    def _place(self, frame: Frame) -> tuple[float, ...]:
        """Frame and transform: photograph = (xx u + xy v + x0, yx u + yy v + y0) for crop pixels (u, v)."""
        scale, angle = frame.side / self.size, radians(frame.roll_deg)
        c, s = scale * cos(angle), scale * sin(angle)
        x0, y0 = frame.corners()[0]
        return frame.x, frame.y, frame.side, frame.roll_deg, c, -s, x0, s, c, y0

    def _write(self, pixels: np.ndarray, frame: Frame, photo: str, number: int) -> str:
        """Write a part of a photograph as the face of that number; its file, named as no other crop is."""
        stem = str(PurePosixPath(photo).with_suffix("")).lstrip("/").replace("..", "__")
        while (file := stem + (f"-{number}" if number > 1 else "") + ".png").casefold() in self.taken:
            number += 1
        self.taken.add(file.casefold())
        with atomic_file(self.out / file) as temporary:
            cut = frame.cut(pixels, self.size).transpose(1, 2, 0)
            Image.fromarray(np.ascontiguousarray(cut)).save(temporary, format="PNG")
        return file

    def _doubt(self, pixels: np.ndarray, face: Face, frame: Frame) -> str:
        """Why a face is rejected that was found; empty where it is not."""
        if abs(face.yaw_deg) > PROFILE_DEG:
            return f"turned by about {face.yaw_deg:.0f} degrees: models of faces know {PROFILE_DEG:.0f}"
        if self.model is None or self.held_out is None:
            return ""
        crop = frame.cut(pixels, self.model.image_size)[None]
        percentile = float(errors.reconstruction_percentile(self.model, crop, self.held_out)[0])
        if percentile <= errors.OUTLIER_PERCENTILE:
            return ""
        return f"the model reconstructs it worse than {percentile:.0f} % of the images it was validated on"


def _row(
    photo: str, rejected: str, file: str = "", box: Sequence[float] = (), place: Sequence[float] = ()
) -> dict[str, str]:
    """A row of the table; ``box`` is confidence and sides, ``place`` everything after."""
    numbers = dict(zip(COLUMNS[3:8], box, strict=False)) | dict(zip(COLUMNS[8:], place, strict=False))
    texts = {name: str(round(float(one), 4)) for name, one in numbers.items()}
    return dict.fromkeys(COLUMNS, "") | {"file": file, "photo": photo, "rejected": rejected} | texts


def _read(file: Path) -> tuple[dict[str, Any] | None, list[dict[str, str]]]:
    """Options (None for none) and rows of an earlier run, without its last photograph if it was stopped."""
    if not file.exists():
        return None, []
    try:
        first, *lines = StringIO(read_text(file, LINES_LIMIT_BYTES), newline="").readlines() or [""]
        plan = parse_json(first[2:], dict[str, Any]) if first.startswith("# {") else None
        if lines and not lines[-1].endswith("\n"):  # the run was killed while it wrote
            del lines[-1]
        reader = csv.DictReader(lines if plan is not None else [first, *lines])
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError("its columns are others")
        rows = list(reader)
        if any(None in row or None in row.values() for row in rows):
            raise ValueError("a row is longer or shorter than the first")
    except (ValueError, csv.Error) as error:
        what = f"{file} is no table of derender align ({first_line(error)})"
        raise ValueError(f"{what}: choose another folder") from error
    last = rows[-1]["photo"] if rows and plan is not None else None
    return plan, [row for row in rows if row["photo"] != last]


def _write(file: Path, rows: list[dict[str, str]], plan: dict[str, Any] | None = None) -> None:
    with atomic_file(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        stream.write("" if plan is None else f"# {json.dumps(plan)}\n")
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
