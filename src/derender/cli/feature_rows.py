"""From command line options to rows of features: tables from files or models, controls from the pictures.

``NAME=PATH`` names a row; a name given twice is one row of several runs. Embeddings are remembered by the
content of weights and pictures.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli.console import notice, progress_bar, report_images

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.memory import Memory
    from derender.evaluation.score_table import ScoreTable
    from derender.features import FeatureTable

Features = Annotated[
    str | None,
    typer.Option("--features", "-f", help="A table made by derender embed.", metavar="FILE.parquet"),
]
ControlData = Annotated[
    str | None,
    typer.Option("--data", "-d", help="Pictures: of the model, or of the table for its controls."),
]
DEFAULT_FACTORS = "geometry,albedo"
Factors = Annotated[str, typer.Option("--factors", help="Features to use, with commas between, or all.")]
MeanBy = Annotated[
    list[str] | None,
    typer.Option("--mean-by", help="Average first over rows that share this label; may be repeated."),
]
MinCount = Annotated[
    int, typer.Option("--min-count", min=1, metavar="N", help="Leave out classes with fewer rows.")
]
MaxCount = Annotated[
    int | None, typer.Option("--max-count", min=1, metavar="N", help="At most so many rows of a class.")
]
Markdown = Annotated[
    str | None, typer.Option("--markdown", help="Also write the tables as Markdown.", metavar="FILE")
]
Latex = Annotated[
    str | None, typer.Option("--latex", help="Also write the tables as LaTeX (booktabs).", metavar="FILE")
]
Cache = Annotated[
    str | None,
    typer.Option(
        "--cache", help="Folder for what took long; 'none' keeps nothing. By default the user's cache.",
        metavar="DIR",
    ),
]  # fmt: skip
WhitenOn = Annotated[
    str | None,
    typer.Option(
        "--whiten-on",
        help="Also: codes not whitened, and controls whitened by the model's renderings of these pictures "
        "(give those it was trained on).",
        metavar="PATH",
    ),
]
UntrainedSeeds = Annotated[
    int, typer.Option("--untrained-seeds", min=1, metavar="N", help="Untrained encoders to average over.")
]
Resamples = Annotated[
    int, typer.Option("--resamples", min=2, metavar="N", help="Bootstrap resamples of the scored rows.")
]


def memory_in(cache: str | None) -> "Memory":
    """Where results are remembered."""
    from derender.data import cache_folder
    from derender.evaluation.memory import Memory

    if cache is not None and cache.lower() == "none":
        return Memory()
    return Memory(cache_folder() / "scores" if cache is None else Path(cache))


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


def model_facts(model: Any) -> dict[str, Any]:
    """What decides a model's renderings and features, for what is remembered of them."""
    from derender.features import model_fingerprint

    return {"weights": model_fingerprint(model), "model": model.settings.model_dump(mode="json")}


def factors_of(text: str) -> tuple[str, ...] | None:
    """``geometry,albedo`` as names; None for ``all``."""
    return None if text == "all" else tuple(name.strip() for name in text.split(","))


def rows_from_tables(files: dict[str, list[str]], factors: tuple[str, ...] | None) -> "list[FeatureRow]":
    """Rows read from parquet files. Factors that a table of another origin lacks mean all it has."""
    from derender.evaluation.feature_rows import FeatureRow
    from derender.features import FeatureTable

    rows = []
    for name, paths in files.items():
        tables = tuple(FeatureTable.read(path) for path in paths)
        foreign = factors is not None and not set(factors) & set(tables[0].factors)
        rows.append(FeatureRow(name, tables, None if foreign else factors, "control" in tables[0].origin))
    return rows


def rows_from_models(
    models: dict[str, list[str]],
    pictures_at: "Pictures",
    factors: tuple[str, ...] | None,
    device: str,
    memory: "Memory",
) -> "list[FeatureRow]":
    """Rows of models applied to the pictures."""
    from derender.cli.models import open_model
    from derender.evaluation.feature_rows import FeatureRow

    rows = []
    for name, paths in models.items():
        tables = []
        for path in paths:
            net = open_model(path, device)
            tables.append(embedded(net, pictures_at.at(net.image_size), memory, f"embedding {name}"))
        rows.append(FeatureRow(name, tuple(tables), factors))
    return rows


class Source:
    """What a command was given: one table or one model, pictures, a device and a memory."""

    def __init__(
        self,
        features: str | None,
        model: str | None,
        data: str | None,
        dataset: str,
        limit: int | None,
        device: str,
        cache: str | None,
        whiten_on: str | None = None,
    ):
        if (features is None) == (model is None):
            raise ValueError("give either --features FILE, or --model M with --data D")
        if model is not None and data is None:
            raise ValueError("--model needs --data: the pictures to embed")
        self.features, self.model, self.device, self.memory = features, model, device, memory_in(cache)
        self.pictures = None if data is None else Pictures(data, dataset, limit)
        self.whiten_on = whiten_on
        if whiten_on is not None and model is None:
            raise ValueError(
                "--whiten-on renders pictures again, which a table of features cannot: give --model M with "
                "--data D"
            )

    def row_name(self, factors: str) -> str:
        """What the first row is called."""
        return factors.replace(",", " + ")

    def rows(self, factors: str, seeds: Sequence[int]) -> "list[FeatureRow]":
        """The features, then the controls that the pictures give; without pictures there are none."""
        chosen, name = factors_of(factors), self.row_name(factors)
        if self.features is not None:
            rows = rows_from_tables({name: [self.features]}, chosen)
            table = rows[0].tables[0]
            if chosen is not None and rows[0].factors is None:
                if factors != DEFAULT_FACTORS:
                    table.concatenate(chosen)  # says which factor there is not
                rows = [replace(rows[0], name=" + ".join(table.factors))]
        else:
            assert self.model is not None and self.pictures is not None
            rows = rows_from_models({name: [self.model]}, self.pictures, chosen, self.device, self.memory)
        if self.pictures is None:
            notice("without --data there are no pixels, PCA and untrained encoder to compare with")
            return rows
        settings = architecture(rows)
        size = 64 if settings is None else settings.network.image_size
        pictures = self.pictures_of(size, rows[0].tables[0].files)
        controls = control_rows(pictures, settings, chosen, seeds, self.device, self.memory)
        if self.whiten_on is None:
            return [*rows, *controls]
        from derender.cli.whitened_rows import whitened_rows

        more = whitened_rows(self, pictures, factors, seeds, self.whiten_on)
        ours = [row for row in more if not row.control]
        return [*rows, *ours, *controls, *(row for row in more if row.control)]

    def pictures_of(self, image_size: int, files: Sequence[str]) -> "PictureSet":
        """The pictures of a table's rows, in their order."""
        assert self.pictures is not None
        return aligned(self.pictures.at(image_size), files)


def aligned(pictures: "PictureSet", files: Sequence[str]) -> "PictureSet":
    """The pictures with these names, in this order."""
    if pictures.files == tuple(files):
        return pictures
    place = {file: row for row, file in enumerate(pictures.files)}
    absent = [file for file in files if file not in place]
    if absent:
        raise ValueError(
            f"{len(absent)} of {len(files)} rows of the table are not among the pictures of "
            f"{pictures.source} (first {absent[0]}): give the data that the table was made from"
        )
    return pictures.select([place[file] for file in files])


def chosen_labels(
    rows: "Sequence[FeatureRow]", label: Sequence[str] | None, attributes: bool, least: int = 1
) -> tuple[str, ...]:
    """Label columns by name, or every yes/no column that has ``least`` rows of either answer."""
    table = rows[0].tables[0]
    if bool(label) == attributes:
        raise ValueError("give either --label NAME (may be repeated) or --attributes")
    if attributes:
        return asked_attributes(table, least)
    names = tuple(dict.fromkeys(label or ()))
    for name in names:
        table.label(name)
    return names


def asked_attributes(table: "FeatureTable", least: int = 1) -> tuple[str, ...]:
    """Every yes/no column that has ``least`` rows of either answer; says which have not."""
    from derender.evaluation.tables import attribute_columns

    there, names = attribute_columns(table), attribute_columns(table, least)
    if not there:
        raise ValueError(f"there is no yes/no label; there is {', '.join(table.labels) or 'no label'}")
    rows = "no row" if least == 1 else f"fewer than {least} rows"
    if not names:
        raise ValueError(f"every yes/no label has {rows} of one of its answers: give more pictures")
    if left := [name for name in there if name not in names]:
        notice(f"left out, with {rows} of one of their answers: {', '.join(left)}")
    return names


def whole_numbers(text: str, option: str) -> tuple[int, ...]:
    """``100,500`` as numbers."""
    try:
        return tuple(dict.fromkeys(int(word) for word in text.split(",")))
    except ValueError as error:
        raise ValueError(f"{option} {text!r} should read like 100,500,1000") from error


class Pictures:
    """A data set that is read once for each size asked for."""

    def __init__(self, data: str, dataset: str, limit: int | None = None):
        self.data, self.dataset, self.limit = data, dataset, limit
        self._read: dict[int, PictureSet] = {}

    def at(self, image_size: int) -> "PictureSet":
        from derender.data import read_pictures

        if image_size not in self._read:
            with progress_bar("reading") as report:
                pictures = read_pictures(
                    self.data, image_size, dataset=self.dataset, limit=self.limit, progress=report
                )
            report_images(pictures)
            self._read[image_size] = pictures
        return self._read[image_size]


def control_rows(
    pictures: "PictureSet",
    settings: Any,
    factors: tuple[str, ...] | None,
    seeds: Sequence[int],
    device: str,
    memory: "Memory",
    fit_on: "PictureSet | None" = None,
) -> "list[FeatureRow]":
    """An untrained encoder for each seed (if ``settings`` of an architecture are known), PCA and pixels.

    PCA's components are those of ``fit_on``, by default of the pictures themselves.
    """
    from derender.baselines.controls import pca_features, pixel_features
    from derender.cli.models import chosen_device
    from derender.evaluation.feature_rows import FeatureRow
    from derender.model import Derenderer

    rows = []
    if settings is not None:
        tables = []
        for seed in seeds:
            twin = Derenderer.seeded(settings, seed).to(chosen_device(device)).eval()
            table = embedded(twin, pictures, memory, f"untrained encoder {seed}")
            tables.append(replace(table, origin={**table.origin, "control": "untrained", "seed": seed}))
        rows.append(FeatureRow("untrained encoder", tuple(tables), factors, control=True))
    fitted = pictures if fit_on is None else fit_on
    components = max(1, min(64, len(fitted) // 4))  # whitening needs many more rows than components
    apart = {} if fit_on is None else {"fit_on": fit_on.images}
    pca = remembered(
        memory,
        "pca",
        {"images": pictures.images, "components": components, **apart},
        pictures,
        lambda: pca_features(pictures, components=components, fit_on=fitted),
    )
    rows.append(FeatureRow(f"PCA ({components})", (pca,), control=True))
    rows.append(FeatureRow("pixels", (pixel_features(pictures),), control=True))
    return rows


def embedded(model: Any, pictures: "PictureSet", memory: "Memory", what: str) -> "FeatureTable":
    """A model's features of pictures, remembered by the content of both."""
    from derender.features import embed_pictures, model_fingerprint

    def make() -> "FeatureTable":
        with progress_bar(what) as report:
            return embed_pictures(model, pictures, progress=report)

    inputs = {"weights": model_fingerprint(model), "images": pictures.images}
    table = remembered(memory, "embedding", inputs, pictures, make)
    origin = {"settings": model.settings.model_dump(mode="json"), "weights": inputs["weights"]}
    return replace(table, origin={**table.origin, **origin})


def remembered(
    memory: "Memory", what: str, inputs: dict[str, Any], pictures: "PictureSet", make: Any
) -> "FeatureTable":
    """A feature table whose arrays are remembered; names and labels come from the pictures."""
    from derender.features import FeatureTable, table_labels

    factors = memory.recall(what, inputs, lambda: dict(make().factors))
    origin = {"data": pictures.source, "layout": pictures.layout}
    return FeatureTable(pictures.files, factors, table_labels(pictures), origin)


def architecture(rows: "Sequence[FeatureRow]") -> Any:
    """The model settings of the first table that a model of ours made; None if there is none."""
    from pydantic import ValidationError

    from derender.model import Derenderer
    from derender.presets import ModelSettings

    for row in rows:
        origin = row.tables[0].origin
        ours = origin.get("model", Derenderer.__name__) == Derenderer.__name__
        stored = origin.get("settings") if ours else None
        if stored is not None and not row.control:
            try:
                return ModelSettings.model_validate(stored)
            except ValidationError as error:
                first = error.errors()[0]
                raise ValueError(
                    f"features {row.name!r} were made by a model this version does not know "
                    f"({'.'.join(map(str, first['loc']))}: {first['msg']}): embed the data again"
                ) from error
    return None


def write_tables(tables: "Sequence[ScoreTable]", markdown_file: str | None, latex_file: str | None) -> None:
    """What ``--markdown`` and ``--latex`` ask for."""
    from derender.evaluation.score_table import Scores
    from derender.storage.atomic import atomic_file

    scores = Scores(tables, {})
    for target, form in ((markdown_file, scores.to_markdown), (latex_file, scores.to_latex)):
        if target is not None:
            with atomic_file(Path(target)) as temporary:
                temporary.write_text(form(), encoding="utf-8")


def refuse_to_replace(force: bool, *targets: str | None) -> None:
    """Files that are there already stay, unless told otherwise; asked before anything is computed."""
    for target in targets:
        if target is None or target == "-":
            continue
        if Path(target).is_dir():
            raise ValueError(f"{target} is a folder: name a file to write")
        if Path(target).exists() and not force:
            raise ValueError(f"{target} exists already: choose another name, or add --force to replace it")
