"""`derender evaluate disentangle`: does each feature hold its own factor, and only that?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, result


@dataclass(frozen=True)
class CardImages(options.PartOfImages):
    """The images of the card."""

    limit: options.Limit = 2000


PNG = "PNG file for all matrices."
Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE.png", help=PNG)]
Seeds = Annotated[int, scoring.number(max=20, help="Number of seeds.")]
Swapped = Annotated[int, scoring.number(min=2, help="Most images in the swap test.")]
DIMENSIONS = "Scores by dimension: lasso, trees (takes minutes), or none."
Dimensions = Annotated[Literal["lasso", "trees", "none"], typer.Option(help=DIMENSIONS)]


def disentangle(
    images: CardImages, trained: options.TrainedModel, published: scoring.Published, out: Out = None,
    seeds: Seeds = 3, swap_pictures: Swapped = 256, dimensions: Dimensions = "lasso",
    batch_size: options.BatchSize = 64, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Does each feature hold its own factor? Correlation, CKA, swap test; on rendered data DCI, MIG, SAP."""
    published.check(out, [".png"])
    from derender import evaluation
    from derender.evaluation.memory import memory_in

    model, memory = trained.open(), memory_in(cache)
    chosen = images.read(model.image_size, model=trained.model)
    with progress_bar("scoring", "steps") as report:
        scores = evaluation.disentangle(
            model, chosen, seeds=range(seed, seed + seeds), swap_images=swap_pictures,
            dimensions=None if dimensions == "none" else dimensions, batch_size=batch_size, memory=memory,
            progress=report,
        )  # fmt: skip
    if out is not None:
        from derender.report.matrices import write_card

        write_card(scores.result, f"{trained.model}: {len(chosen):,} images", out)
        result(f"matrices in {out}", published.json_file)
    published.publish(scores, memory)
