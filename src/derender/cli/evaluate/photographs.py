"""`derender evaluate pose`, `light`, `relight` and `brightness`: predicted scenes against known ones."""

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from derender.cli import options, scoring
from derender.cli.options import option

TABLE = ".npz, .csv or .parquet with name and the angles in degrees; default: labels."
Angles = Annotated[str | None, typer.Option("--table", metavar="FILE", help=TABLE)]
BY = "Without true albedo: label of the groups to compare, as race."


@dataclass(frozen=True)
class Decomposed(options.TrainedModel):
    """The model that decomposes, and how its scenes are scored."""

    fit_steps: options.FitSteps = None
    resamples: scoring.Resamples = 1_000
    seed: options.Seed = 0

    def score(
        self, protocol: str, images: options.DataOptions, published: scoring.Published, **how: Any
    ) -> None:
        """Score by a protocol of `derender.evaluation`, and publish."""
        how |= {"fit_steps": self.fit_steps, "resamples": self.resamples, "seed": self.seed, **images.how}
        result = scoring.measured(protocol, self.open(), images.address, doing="decomposing", **how)
        published.publish(result, half=images.half)


def pose(
    images: options.DataOptions, model: Decomposed, published: scoring.Published, table: Angles = None
) -> None:
    """Yaw, pitch and roll against known angles: correlation, slope and error, beside controls."""
    model.score("pose", images, published, table=table)


def light(
    images: options.DataOptions, model: Decomposed, published: scoring.Published, table: Angles = None
) -> None:
    """Direction of the light against the known one: correlation, slope and error, beside controls."""
    model.score("light", images, published, table=table)


def relight(
    images: options.DataOptions, model: Decomposed, published: scoring.Published,
    size: int = scoring.number(128, "Side in pixels of the images that are relit."),
) -> None:  # fmt: skip
    """Relit images against photographs in that light: PSNR and SSIM inside the mask, beside controls.

    The light is predicted for another person's image. Images: the cropped Extended Yale B, or others with
    identity and light among their labels.
    """
    model.score("relight", images, published, size=size)


def brightness(
    images: options.DataOptions, model: Decomposed, published: scoring.Published,
    by: str | None = option(None, BY, metavar="LABEL"),
) -> None:  # fmt: skip
    """Is albedo as bright as the surface? Slope and r on rendered images; by group on photographs."""
    model.score("brightness", images, published, by=by)
