"""What became of one picture when its light, its view or a factor was changed, on disk.

A folder per picture: strip.png (labelled), each still as a PNG with transparency, film.gif, film.mp4, and
moved.json with the numbers of every still. The folder appears whole or not at all.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from derender.data import suggestion
from derender.report.colours import Images
from derender.report.films import gif, mp4
from derender.report.panel import GridLayout, labelled_grid
from derender.storage.atomic import atomic_folder

FILMS = {"gif": gif, "mp4": mp4}
SMALLEST_CELL = 128


@dataclass(frozen=True)
class Moved:
    """One picture, changed.

    Attributes:
        before: images of what it was made from, by label; they come first in the strip.
        stills: what came out, by label.
        numbers: what holds in each still, by the same labels: anything JSON can hold.
        film: frames of a film; empty for none.
    """

    before: Mapping[str, Image.Image]
    stills: Mapping[str, Image.Image]
    numbers: Mapping[str, Any]
    film: Images = field(default_factory=list)

    @property
    def columns(self) -> dict[str, Image.Image]:
        """All images by label, in the order of the strip."""
        return {**self.before, **self.stills}

    def strip(self) -> Image.Image:
        """All images in one labelled row, as large as the stills are, and large enough to see."""
        cell = max(SMALLEST_CELL, *(still.width for still in self.stills.values()))
        return labelled_grid(
            {name: [image] for name, image in self.columns.items()}, layout=GridLayout(cell=cell)
        )


def film_kinds(text: str) -> tuple[str, ...]:
    """``gif,mp4`` as kinds of film, ``none`` as none; an unknown one is an error that names the nearest."""
    kinds = tuple(dict.fromkeys(kind.strip().lower() for kind in text.split(",")))
    if kinds == ("none",):
        return ()
    for kind in kinds:
        if kind not in FILMS:
            raise ValueError(
                f"unknown kind of film {kind!r}{suggestion(kind, FILMS)}; there is {', '.join(FILMS)}, none"
            )
    return kinds


def write_moved(
    folder: Path,
    moved: Moved,
    record: Mapping[str, Any],
    films: Sequence[str] = ("gif", "mp4"),
    seconds: float = 2.4,
) -> dict[str, Any]:
    """Write one picture's folder; gives what its moved.json says: the record, and each still's numbers."""
    with atomic_folder(folder) as temporary:
        moved.strip().save(temporary / "strip.png")
        told = []
        for number, (label, still) in enumerate(moved.stills.items(), 1):
            name = f"still-{number:02d}.png"
            still.save(temporary / name)
            told.append({"file": name, "label": label, **moved.numbers[label]})
        for kind in films if moved.film else ():
            (temporary / f"film.{kind}").write_bytes(FILMS[kind](moved.film, seconds))
        written = {**record, "folder": str(folder), "stills": told}
        (temporary / "moved.json").write_text(
            json.dumps(written, indent=1, ensure_ascii=False), encoding="utf-8"
        )
    return written
