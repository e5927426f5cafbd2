"""`derender evaluate disentangle`: does each feature hold its own factor, and only that?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, refuse_existing_file, result
from derender.cli.gathered import gathered

Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="PNG file for all matrices.", metavar="FILE.png")
]
Seeds = Annotated[int, typer.Option("--seeds", min=1, max=20, metavar="N", help="Number of seeds.")]
SwapImages = Annotated[
    int,
    typer.Option("--swap-pictures", min=2, metavar="N", help="Most images in the swap test."),
]
Dimensions = Annotated[
    str, typer.Option("--dimensions", help="Scores by dimension: lasso, trees (takes minutes), or none.")
]


@dataclass(frozen=True)
class CardImages(options.PartOfImages):
    """The images of the card."""

    limit: options.Limit = 2000


def register(group: typer.Typer) -> None:
    group.command(
        "disentangle",
        epilog="Example: derender evaluate disentangle made/ --model runs/faces --out card.png",
    )(disentangle)


@gathered
def disentangle(
    images: CardImages,
    trained: options.TrainedModel,
    published: scoring.Published,
    out: Out = None,
    seeds: Seeds = 3,
    swap_pictures: SwapImages = 256,
    dimensions: Dimensions = "lasso",
    batch_size: options.BatchSize = 64,
    seed: options.Seed = 0,
    cache: scoring.Cache = None,
) -> None:
    """Does each feature hold its own factor? Correlation, CKA, swap test; on rendered data DCI, MIG, SAP."""
    if dimensions not in ("lasso", "trees", "none"):
        raise ValueError(f"unknown --dimensions {dimensions!r}: choose lasso, trees or none")
    if out is not None:
        if out.suffix.lower() != ".png":
            raise ValueError(f"--out {out} must end in .png: the matrices are drawn as a PNG image")
        refuse_existing_file(out, published.force)
    published.check()
    from derender import evaluation
    from derender.evaluation.memory import memory_in

    model, memory = trained.open(), memory_in(cache)
    pictures = images.read(model.image_size, model=trained.model)
    with progress_bar("scoring", "steps") as report:
        scores = evaluation.disentangle(
            model, pictures, seeds=range(seed, seed + seeds), swap_images=swap_pictures,
            dimensions=None if dimensions == "none" else dimensions, batch_size=batch_size, memory=memory,
            progress=report,
        )  # fmt: skip
    if out is not None:
        from derender.report.matrices import write_card

        write_card(scores.result, f"{trained.model}: {len(pictures):,} images", out)
        result(f"matrices in {out}", published.json_file)
    published.show(scores.tables, scores.values, [*scores.notes, scoring.remembered(memory)])
