"""`derender doctor`: whether a folder suits the method, before anyone trains."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing_file, result, write_json

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.data.doctor import Examination, Originals

UNREADABLE_SAID = 5


def register(app: typer.Typer) -> None:
    app.command("doctor", epilog="Example: derender doctor photos/ --out doctor.html")(doctor)


def doctor(
    data: Annotated[
        str, typer.Argument(help="Folder, zip, or PATH::SUBSET for one part of a data set.", metavar="PATH")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Also write a page with example pictures.", metavar="FILE.html"),
    ] = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    seed: options.Seed = 0,
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Say whether pictures suit the method: copies, crop, symmetry, view and light. Trains nothing."""
    if out is not None:
        refuse_existing_file(out, force)
    if json_file is not None and json_file != "-":
        refuse_existing_file(Path(json_file), force)
    from derender.data import read_pictures
    from derender.data.doctor import EXAMINED_PX, examine

    _refuse_one_file(data)
    with progress_bar("reading") as report:
        pictures = read_pictures(
            data, EXAMINED_PX, dataset=dataset, limit=limit, keep_duplicates=True, progress=report
        )
    originals = _originals(data, pictures, dataset)
    with progress_bar("examining") as report:
        found = examine(pictures, originals, seed=seed, progress=report)
    notice(pictures.describe())
    _tell(pictures, found, json_file)
    values = _values(pictures, found)
    if out is not None:
        from derender.report.doctor import doctor_page

        values["report"] = doctor_page(pictures, found).write(out)
        result(f"report {out}", json_file)
    else:
        notice("add --out doctor.html for a page with example pictures")
    write_json(json_file, values)


def _refuse_one_file(data: str) -> None:
    from derender.data import is_picture

    if Path(data).is_file() and is_picture(data):
        raise ValueError(
            f"{data} is one picture: a set of pictures is examined as a whole, give its folder or zip"
        )


def _originals(data: str, pictures: "PictureSet", dataset: str) -> "Originals | None":
    """Sizes of the files where they can be asked for by name; a stream's cannot."""
    from derender.data import list_images, parse_source
    from derender.data.doctor import EXAMINED_PX, measure_originals

    if not parse_source(data)[0].exists():
        return None
    try:
        listed = list_images(data, dataset=dataset)
    except ValueError:  # shards: read as a stream
        return None
    with listed:
        if not set(pictures.files) <= set(listed.files.files):
            return None
        return measure_originals(listed.files, pictures.files, EXAMINED_PX)


def _tell(pictures: "PictureSet", found: "Examination", json_file: str | None) -> None:
    """The findings as the page has them, worst first, and the verdict."""
    for row in pictures.skipped[:UNREADABLE_SAID]:
        notice(f"unreadable: {row.file}: {row.reason}")
    if len(pictures.skipped) > UNREADABLE_SAID:
        notice(f"and {len(pictures.skipped) - UNREADABLE_SAID:,} more unreadable files (--json names all)")
    words = {"objection": "NO", "trouble": "!", "note": "note", "open": "?", "good": "ok"}
    for level, word in words.items():
        for finding in found.findings:
            if finding.level == level:
                advice = f" {finding.advice}" if finding.advice else ""
                result(f"{word:>4}  {finding.name}: {finding.text}{advice}", json_file)
    result(f"verdict: {found.verdict.text}", json_file)


def _values(pictures: "PictureSet", found: "Examination") -> dict[str, Any]:
    measures, shared = found.measures, found.measures.shared
    names = ("agreement", "symmetry", "fill", "view", "light", "odd", "axis", "explained", "explained_rolled")
    return {
        "source": pictures.source,
        "verdict": found.verdict.word,
        "because": found.verdict.because,
        "findings": found.findings,
        "pictures": measures.pictures,
        "distinct": measures.distinct,
        "identical": measures.identical,
        "near_copies": measures.near_copies,
        "clipped": measures.clipped,
        "grey": measures.pixels.colourless.mean(),
        "blank": measures.pixels.blank.sum(),
        "originals": found.originals,
        "compared": 0 if shared is None else len(shared.rows),
        "measures": None if shared is None else {name: getattr(shared, name) for name in names},
        "kinship": None if shared is None or shared.halves is None else shared.halves.kinship,
        "unreadable": pictures.skipped,
        "copies": [
            {"file": pictures.files[row], "first": pictures.files[first]}
            for row, first in enumerate(measures.group)
            if row != first
        ],
    }
