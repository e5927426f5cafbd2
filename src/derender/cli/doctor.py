"""`derender doctor`: whether a folder suits the method, before anyone trains."""

from pathlib import Path

import typer

from derender.cli.console import notice, progress_bar, refuse_existing_file, report_images
from derender.cli.options import DataOptions, Output, Seed, command, option

WORDS = {"objection": "NO", "trouble": "!", "note": "note", "open": "?", "good": "ok"}  # worst first


@command("doctor", "doctor photos/ --out doctor.html")
def doctor(
    image_set: DataOptions,
    output: Output,
    out: Path | None = option(None, "Also write a page with examples.", "--out", "-o", metavar="FILE.html"),
    seed: Seed = 0,
    check: bool = option(False, "Exit with 1 where the images do not suit the method.", "--check"),
) -> None:
    """Say whether images suit the method: copies, crop, symmetry, view and light. Trains nothing."""
    for file in (out, output.json_file):
        if file is not None and file != "-":
            refuse_existing_file(Path(file), output.force)
    from derender.data.doctor import doctor as examine

    with progress_bar("examining") as report:
        result = examine(image_set.address, **image_set.how, seed=seed, progress=report)
    report_images(result.images, "unreadable:", "unreadable files (--json names all)")
    for finding in sorted(result.findings, key=lambda one: list(WORDS).index(one.level)):
        advice = f" {finding.advice}" if finding.advice else ""
        output.result(f"{WORDS[finding.level]:>4}  {finding.name}: {finding.text}{advice}")
    output.result(f"verdict: {result.verdict.text}")
    values = result.as_json()
    if out is not None:
        from derender.report.run import doctor_page

        values["report"] = doctor_page(result).write(out)
        output.result(f"report {out}")
    else:
        notice("add --out doctor.html for a page with example images")
    output.write(values)
    if check and result.verdict.word == "does not suit":
        raise typer.Exit(1)
