"""Option groups of the commands that score features, and where their tables go (gathered.py)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from derender.cli import options
from derender.cli.console import notice, show_scores, write_json

if TYPE_CHECKING:
    from derender.evaluation.feature_rows import FeatureSource
    from derender.evaluation.memory import Memory
    from derender.evaluation.score_table import Scores, ScoreTable

Method = Annotated[Literal["ward", "finch", "k-means"], typer.Option("--method", help="Clustering method.")]
Label = Annotated[
    list[str] | None, typer.Option("--label", "-l", help="Label column; repeated: mean over yes/no labels.")
]
Attributes = Annotated[bool, typer.Option("--attributes", help="Score by every yes/no label.")]
Features = Annotated[
    str | None, typer.Option("--features", "-f", help="Table made by derender embed.", metavar="FILE.parquet")
]
AModel = Annotated[
    str | None,
    typer.Option("--model", "-m", help=f"Instead of --features, with IMAGES. {options.MODELS}"),
]
Factors = Annotated[str, typer.Option("--factors", help="Features to use, with commas between, or all.")]
MinCount = Annotated[
    int, typer.Option("--min-count", min=1, metavar="N", help="Leave out classes of fewer rows.")
]
MaxCount = Annotated[
    int | None, typer.Option("--max-count", min=1, metavar="N", help="Use at most N rows of a class.")
]
WhitenOn = Annotated[
    str | None,
    typer.Option(
        "--whiten-on", metavar="PATH",
        help="Also score the codes without whitening, and controls whitened by the model's renderings of "
        "these images (best those of its training).",
    ),
]  # fmt: skip
UntrainedSeeds = Annotated[
    int, typer.Option("--untrained-seeds", min=1, metavar="N", help="Number of untrained encoders averaged.")
]
Resamples = Annotated[
    int, typer.Option("--resamples", min=2, metavar="N", help="Number of bootstrap resamples of the rows.")
]
Cache = Annotated[
    str | None,
    typer.Option("--cache", help="Folder of cached results, or none; default: the user's.", metavar="DIR"),
]
Markdown = Annotated[
    str | None, typer.Option("--markdown", help="Also write the tables as Markdown.", metavar="FILE")
]
Latex = Annotated[
    str | None, typer.Option("--latex", help="Also write the tables as LaTeX (booktabs).", metavar="FILE")
]
Html = Annotated[
    str | None, typer.Option("--html", help="Also write the tables and charts as one page.", metavar="FILE")
]


@dataclass(frozen=True)
class Labels:
    """The labels of a score, and the rows that carry them."""

    label: Label = None
    attributes: Attributes = False
    min_count: MinCount = 1
    max_count: MaxCount = None


@dataclass(frozen=True)
class ScoredSubject:
    """The features that are scored: one table or one model."""

    features: Features = None
    model: AModel = None
    factors: Factors = "geometry,albedo"
    whiten_on: WhitenOn = None

    def source(self, images: str | None) -> "FeatureSource":
        """The table or the model."""
        from derender.features import FeatureTable

        if (self.features is None) == (self.model is None):
            raise ValueError("give either --features FILE, or --model M with IMAGES")
        if self.model is None:
            return FeatureTable.read(str(self.features))
        if images is None:
            raise ValueError("--model needs IMAGES to embed")
        return self.model


@dataclass(frozen=True)
class Computed:
    """How scores are computed, and where results that took long are cached."""

    resamples: Resamples = 1_000
    seed: options.Seed = 0
    device: options.Device = "auto"
    cache: Cache = None

    def from_seed(self, count: int) -> range:
        """So many seeds, from ``seed`` on."""
        return range(self.seed, self.seed + count)


@dataclass(frozen=True)
class Published:
    """Where tables go besides the terminal."""

    json_file: options.Json = None
    markdown: Markdown = None
    latex: Latex = None
    html: Html = None
    force: options.Force = False

    def check(self) -> None:
        """Refuse to write over tables, and into folders, before anything is computed."""
        for target in (self.markdown, self.latex, self.html, self.json_file):
            if target is None or target == "-":
                continue
            if Path(target).is_dir():
                raise ValueError(f"{target} is a folder: name a file to write")
            if Path(target).exists() and not self.force and target != self.json_file:
                raise ValueError(
                    f"{target} exists already: choose another name, or add --force to replace it"
                )

    def publish(self, scores: "Scores") -> None:
        """Show tables and notes, and write every form that was requested."""
        from derender.storage.atomic import atomic_file

        for table in scores.tables:
            show_scores(table, self.json_file)
        for note in scores.notes:
            notice(note)
        write_json(self.json_file, scores.values)
        for target, form in ((self.markdown, scores.to_markdown), (self.latex, scores.to_latex)):
            if target is not None:
                with atomic_file(Path(target)) as temporary:
                    temporary.write_text(form(), encoding="utf-8")
        if self.html is not None:
            from derender.report.comparison import comparison_page

            facts = {name: one for name, one in scores.values.items() if isinstance(one, str | int | float)}
            lead = ". ".join(scores.notes)
            page = comparison_page("Scores beside their controls", scores.tables, lead=lead, facts=facts)
            notice(f"page {page.write(self.html)}")

    def show(
        self, tables: "Sequence[ScoreTable]", values: Mapping[str, Any], notes: Iterable[str] = ()
    ) -> None:
        """See ``publish``."""
        from derender.evaluation.score_table import Scores

        self.publish(Scores(tables, values, list(notes)))


def names_of(text: str) -> tuple[str, ...] | None:
    """``geometry,albedo`` as names; None for ``all``."""
    return None if text == "all" else tuple(name.strip() for name in text.split(","))


def numbers_of(text: str, option: str) -> tuple[int, ...]:
    """``100,500`` as numbers."""
    try:
        return tuple(dict.fromkeys(int(word) for word in text.split(",")))
    except ValueError as error:
        raise ValueError(f"{option} {text!r} should read like 100,500,1000") from error


def named_paths(values: Sequence[str], option: str) -> dict[str, list[str]]:
    """``NAME=PATH`` options by name, in order; a path alone is named after its last part."""
    found: dict[str, list[str]] = {}
    for value in values:
        name, equals, path = value.partition("=")
        if not equals:
            name, path = Path(value).stem or value, value
        if not name or not path:
            raise ValueError(f"{option} {value!r} should read NAME=PATH")
        found.setdefault(name, []).append(path)
    return found


def remembered(memory: "Memory", what: str = "results") -> str:
    """See ``Memory.summary``."""
    return memory.summary(what)
