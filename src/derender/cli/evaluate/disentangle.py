"""`derender evaluate disentangle`: does each feature hold its own factor, and only that?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from derender.cli import options, scoring
from derender.cli.options import option


@dataclass(frozen=True)
class CardImages(options.PartOfImages):
    """The images of the card."""

    limit: options.Limit = 2000


def disentangle(
    images: CardImages, trained: options.TrainedModel, published: scoring.Published,
    out: Path | None = option(None, "PNG file for all matrices.", "--out", "-o", metavar="FILE.png"),
    seeds: int = scoring.number(3, "Number of seeds.", max=20),
    swap_pictures: int = scoring.number(256, "Most images in the swap test.", min=2),
    dimensions: Literal["lasso", "none"] = option("lasso", "Scores by dimension: lasso or none."),
    batch_size: options.BatchSize = 64, seed: options.Seed = 0, cache: scoring.Cache = None,
) -> None:  # fmt: skip
    """Does each feature hold its own factor? Correlation, CKA, swap test; on rendered data DCI, MIG, SAP."""
    published.check_drawing(out, [".png"])
    model = trained.open()
    chosen = images.read(model.image_size, model=trained.model)
    scores = scoring.measured(
        "disentangle", model, chosen, seeds=range(seed, seed + seeds), swap_images=swap_pictures,
        dimensions=None if dimensions == "none" else dimensions, batch_size=batch_size, cache=cache,
        unit="steps",
    )  # fmt: skip
    if out is not None:
        from derender.report.charts import write_card

        write_card(scores.result, f"{trained.model}: {len(chosen):,} images", out)
        published.result(f"matrices in {out}")
    published.publish(scores)
