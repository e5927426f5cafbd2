"""Option groups of the commands that score features, and where their tables go."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Option, Typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, show_scores
from derender.cli.options import option
from derender.storage.atomic import write_whole

if TYPE_CHECKING:
    from derender.evaluation.score_table import Scores

evaluate = Typer(help="Score features or a model, beside controls.", no_args_is_help=True)
options.app.add_typer(evaluate, name="evaluate")

number = partial(option, min=1, metavar="N")  # a whole number, 1 or more
share = partial(option, min=0.01, max=0.99)
target = partial(option, None, metavar="FILE")

Method = Annotated[Literal["ward", "finch", "k-means"], Option(help="Clustering method.")]
Factors = Annotated[str, Option(help="Features to use, with commas between, or all.")]
Counts = Annotated[str, Option(help="Numbers of labelled rows to learn from, with commas between.")]
UntrainedSeeds = Annotated[int, Option(min=1, metavar="N", help="Number of untrained encoders averaged.")]
Resamples = Annotated[int, Option(min=2, metavar="N", help="Number of bootstrap resamples of the rows.")]
Groups = Annotated[str | None, Option(help="Label whose rows stay on one side of the split, as identity.")]
CACHE = "Folder of cached results, or none; default: the user's."
Cache = Annotated[str | None, Option(metavar="DIR", help=CACHE)]
MASKS = "Folder or zip of masks named as the images, if they lie apart."
Masks = Annotated[str | None, Option(metavar="PATH", help=MASKS)]
MODEL = f"Instead of --features, with IMAGES. {options.MODELS}"


@dataclass(frozen=True)
class Labels:
    """The labels of a score, and the rows that carry them."""

    label: list[str] | None = option(None, "Label column; repeated: mean of yes/no labels.", "--label", "-l")
    attributes: bool = option(False, "Score by every yes/no label.", "--attributes")
    min_count: int = number(1, "Leave out classes of fewer rows.")
    max_count: int | None = number(None, "Use at most N rows of a class.")


@dataclass(frozen=True)
class ScoredSubject:
    """The features that are scored: one table or one model."""

    features: str | None = target("Table made by derender embed.", "--features", "-f", metavar="FILE.parquet")
    model: str | None = option(None, MODEL, "--model", "-m")
    factors: Factors = "geometry,albedo"

    def score(self, protocol: str, images: options.DataOptions, published: "Published", **how: Any) -> None:
        """Score by a protocol of `derender.evaluation`, and publish."""
        from derender.data import half_of
        from derender.features import FeatureTable

        how |= {"images": images.optional_address, **images.how, "factors": names_of(self.factors)}
        if (self.features is None) == (self.model is None):
            raise ValueError("give either --features FILE, or --model M with IMAGES")
        if self.model is not None and images.optional_address is None:
            raise ValueError("--model needs IMAGES to embed")
        table, half = self.features, images.half
        source = self.model if table is None else half_of(FeatureTable.read(table), half)
        published.publish(measured(protocol, source, **how), half=half)


@dataclass(frozen=True)
class Computed:
    """How scores are computed, and where results that took long are cached."""

    resamples: Resamples = 1_000
    seed: options.Seed = 0
    device: options.Device = "auto"
    cache: Cache = None


@dataclass(frozen=True)
class Published(options.Output):
    """Where numbers and tables go besides the terminal."""

    markdown: str | None = target("Also write the tables as Markdown.")
    latex: str | None = target("Also write the tables as LaTeX (booktabs).")
    html: str | None = target("Also write the tables and charts as one page.")

    def __post_init__(self) -> None:
        """Refuse, before anything is computed, to write over tables, and into folders."""
        self.check(self.markdown, self.latex, self.html)
        self.check(self.json_file, force=True)

    def publish(self, scores: "Scores", **values: Any) -> None:
        """Show tables and notes, and write every form that was requested; ``values`` are further numbers."""
        values, notes, tables = {**scores.values, **values}, list(scores.notes), scores.tables
        if (half := values.get("half", "all")) != "all":
            tables = [replace(one, caption=f"{one.caption}; {half} half") for one in tables]
            scores = replace(scores, tables=tables)
        for table in tables:
            show_scores(table, self.json_file)
        notice(*notes)
        self.write(values)
        for file, form in ((self.markdown, scores.to_markdown), (self.latex, scores.to_latex)):
            if file is not None:
                write_whole(file, form())
        if self.html is not None:
            from derender.report.protocols import comparison_page

            facts = {name: one for name, one in values.items() if isinstance(one, str | int | float)}
            lead, title = ". ".join(notes), "Scores beside their controls"
            page = comparison_page(title, tables, lead=lead, facts=facts)
            notice(f"page {page.write(self.html)}")


def measured(protocol: str, *given: Any, doing: str = "scoring", unit: str = "images", **how: Any) -> Any:
    """The scores by a protocol of `derender.evaluation`, with a progress bar."""
    from derender import evaluation

    with progress_bar(doing, unit) as progress:
        return getattr(evaluation, protocol)(*given, **how, progress=progress)


def names_of(text: str) -> tuple[str, ...] | None:
    """``geometry,albedo`` as names; None for ``all``."""
    return None if text == "all" else tuple(name.strip() for name in text.split(",") if name.strip())


def numbers_of(text: str, option: str) -> tuple[int, ...]:
    """``100,500`` as numbers."""
    try:
        return tuple(dict.fromkeys(int(word) for word in text.split(",")))
    except ValueError as error:
        raise ValueError(f"{option} {text!r} should read like 100,500,1000") from error


def named_paths(values: Sequence[str], option: str) -> dict[str, list[str]]:
    """``NAME=PATH`` options by name, in order; a path alone is named after its last part."""
    result: dict[str, list[str]] = {}
    for value in values:
        name, equals, path = value.partition("=")
        if not equals:
            name, path = Path(value).stem or value, value
        if not name or not path:
            raise ValueError(f"{option} {value!r} should read NAME=PATH")
        result.setdefault(name, []).append(path)
    return result
