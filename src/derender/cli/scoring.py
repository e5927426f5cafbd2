"""Options of every command that scores features, and what it does with its tables in the end.

Gathered into commands by ``gathered``. Leaves out what any command scores.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from derender.cli import feature_rows, options
from derender.cli.console import notice, show_scores, write_json

if TYPE_CHECKING:
    from derender.evaluation.memory import Memory
    from derender.evaluation.score_table import ScoreTable

Method = Annotated[Literal["ward", "finch", "k-means"], typer.Option("--method", help="How to cluster.")]
Model = Annotated[str | None, typer.Option("--model", "-m", help="Or a model, with --data.")]
Label = Annotated[
    list[str] | None,
    typer.Option("--label", "-l", help="Label column; several for a mean over yes/no questions."),
]
Html = Annotated[
    str | None,
    typer.Option("--html", help="Also write the tables as one page, with a chart each.", metavar="FILE"),
]
Attributes = Annotated[bool, typer.Option("--attributes", help="Ask every yes/no label.")]


@dataclass(frozen=True)
class Asked:
    """What is scored, by which labels: one table or one model."""

    label: Label = None
    attributes: Attributes = False
    features: feature_rows.Features = None
    model: Model = None
    data: feature_rows.ControlData = None
    dataset: options.Dataset = "auto"
    limit: options.Limit = None
    factors: feature_rows.Factors = "geometry,albedo"
    min_count: feature_rows.MinCount = 1
    max_count: feature_rows.MaxCount = None
    whiten_on: feature_rows.WhitenOn = None


@dataclass(frozen=True)
class Computed:
    """How it is computed, and where what took long is kept."""

    resamples: feature_rows.Resamples = 1_000
    seed: options.Seed = 0
    device: options.Device = "auto"
    cache: feature_rows.Cache = None

    def source(self, asked: Asked) -> "feature_rows.Source":
        """The features that were asked for."""
        return feature_rows.Source(
            asked.features, asked.model, asked.data, asked.dataset, asked.limit, self.device, self.cache,
            asked.whiten_on,
        )  # fmt: skip

    def from_seed(self, count: int) -> range:
        """So many seeds, from ``seed`` on."""
        return range(self.seed, self.seed + count)


@dataclass(frozen=True)
class Published:
    """Where tables go besides the terminal."""

    json_file: options.Json = None
    markdown: feature_rows.Markdown = None
    latex: feature_rows.Latex = None
    html: Html = None
    force: options.Force = False

    def check(self) -> None:
        """Refuse to write over tables, and into folders, before anything is computed."""
        feature_rows.refuse_to_replace(self.force, self.markdown, self.latex, self.html)
        feature_rows.refuse_to_replace(True, self.json_file)

    def show(
        self, tables: "Sequence[ScoreTable]", values: Mapping[str, Any], notes: Iterable[str] = ()
    ) -> None:
        """Show tables and notes, and write every form that was asked for."""
        notes = list(notes)
        for table in tables:
            show_scores(table, self.json_file)
        for note in notes:
            notice(note)
        write_json(self.json_file, values)
        feature_rows.write_tables(tables, self.markdown, self.latex)
        if self.html is not None:
            from derender.report.comparison import comparison_page

            facts = {name: value for name, value in values.items() if isinstance(value, str | int | float)}
            page = comparison_page("Scores beside their controls", tables, lead=". ".join(notes), facts=facts)
            notice(f"page {page.write(self.html)}")


def remembered(memory: "Memory", what: str = "results") -> str:
    """One line on what was computed and what was found."""
    folder = "" if memory.folder is None else f" in {Path(memory.folder)}"
    return f"{memory.made} {what} computed, {memory.recalled} found{folder}"
