"""`derender doctor`: whether a folder suits the method, before anyone trains."""

from pathlib import Path
from typing import Annotated

import typer

from derender.cli.console import notice, progress_bar, refuse_existing_file
from derender.cli.gathered import gathered
from derender.cli.options import DataOptions, Output, Seed

UNREADABLE_NAMED = 5
_WORDS = {"objection": "NO", "trouble": "!", "note": "note", "open": "?", "good": "ok"}


def register(app: typer.Typer) -> None:
    app.command("doctor", epilog="Example: derender doctor photos/ --out doctor.html")(gathered(doctor))


def doctor(
    image_set: DataOptions,
    output: Output,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Also write a page with example images.", metavar="FILE.html"),
    ] = None,
    seed: Seed = 0,
) -> None:
    """Say whether images suit the method: copies, crop, symmetry, view and light. Trains nothing."""
    json_file = None if output.json_file in (None, "-") else Path(output.json_file)
    for file in (out, json_file):
        if file is not None:
            refuse_existing_file(file, output.force)
    from derender.data.doctor import doctor as examine

    with progress_bar("examining") as report:
        found = examine(image_set.address, **image_set.how, seed=seed, progress=report)
    notice(found.images.describe())
    skipped = found.images.skipped
    for row in skipped[:UNREADABLE_NAMED]:
        notice(f"unreadable: {row.file}: {row.reason}")
    if len(skipped) > UNREADABLE_NAMED:
        notice(f"and {len(skipped) - UNREADABLE_NAMED:,} more unreadable files (--json names all)")
    for level, word in _WORDS.items():  # worst first
        for finding in found.findings:
            if finding.level == level:
                advice = f" {finding.advice}" if finding.advice else ""
                output.result(f"{word:>4}  {finding.name}: {finding.text}{advice}")
    output.result(f"verdict: {found.verdict.text}")
    values = found.as_json()
    if out is not None:
        from derender.report.doctor import doctor_page

        values["report"] = doctor_page(found).write(out)
        output.result(f"report {out}")
    else:
        notice("add --out doctor.html for a page with example images")
    output.write(values)
