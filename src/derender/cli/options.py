"""Options that several commands share, each declared once."""

from pathlib import Path
from typing import Annotated

import typer

Model = Annotated[
    str,
    typer.Option("--model", "-m", help="Run folder, saved model or Hugging Face Hub id.", metavar="MODEL"),
]
Data = Annotated[
    str,
    typer.Option(
        "--data", "-d", help="Folder, zip, .tar shards or Hugging Face id; ::PART for a part.", metavar="PATH"
    ),
]
Dataset = Annotated[
    str,
    typer.Option("--dataset", help="Layout of the data, if it is not recognised by itself.", metavar="NAME"),
]
Json = Annotated[
    str | None,
    typer.Option("--json", help="Also write the numbers as JSON; - is standard output.", metavar="FILE"),
]
Limit = Annotated[
    int | None, typer.Option("--limit", min=1, metavar="N", help="At most so many pictures, evenly spaced.")
]
BatchSize = Annotated[
    int,
    typer.Option(
        "--batch-size", min=1, metavar="N", help="Pictures at a time; changes speed and memory only."
    ),
]
Part = Annotated[
    str,
    typer.Option(
        "--part", help="all, or the train, validation or test part of the split the model was trained with."
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Same seed, same result.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", metavar="DIR")]
OutModel = Annotated[Path, typer.Option("--out", "-o", help="Folder for the model to make.", metavar="DIR")]
Device = Annotated[str, typer.Option("--device", help="cpu, cuda, or auto.", metavar="NAME")]
FitSteps = Annotated[
    int | None,
    typer.Option(
        "--fit-steps", min=0, max=10_000, metavar="N",
        help="Fit each scene to its picture by rendering, in so many steps (60, say; slow).",
    ),
]  # fmt: skip
