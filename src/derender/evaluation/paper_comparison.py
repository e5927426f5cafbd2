"""The paper's tables for other features and models, beside the paper's numbers and controls.

The tables themselves are data (paper_tables.py); every question of a table that the labels answer is asked
under its protocol.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from derender.data import ImageSet
from derender.evaluation import feature_rows
from derender.evaluation.clustering import clustering_tables, compare_clusterings
from derender.evaluation.clustering_methods import METHODS
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS
from derender.evaluation.linear_probing import FINETUNED, LinearComparison, compare_prepared, linear_tables
from derender.evaluation.options import COUNTS, Options
from derender.evaluation.paper_tables import ATTRIBUTES, TABLES, PaperRow, beside_the_paper
from derender.evaluation.score_table import Column, Row, Scores, ScoreTable, interval_cells, scored_table
from derender.evaluation.segmentation import SegmentSettings, segment
from derender.features import named

PAPER_VARIANTS = ("joint", "geometry", "albedo", "joint-frozen", "random")


def compare(
    table: str, features: Mapping[str, feature_rows.FeatureSource | Sequence[feature_rows.FeatureSource]],
    images: ImageSet | str | Path | None = None, *, method: str = "ward", counts: Sequence[int] = COUNTS,
    seeds: int = 5, finetune: bool = False, supervised: bool = False, masks: str | Path | None = None,
    epochs: int = 20, **options: Any,
) -> Scores:  # fmt: skip
    """One of the paper's tables for several features and models, beside the paper's numbers and controls.

    Args:
        table: "clustering", "identity", "emotion", "linear", "cars", or "segmentation" (of models alone).
        features: by row name, feature tables and models, or several runs (seeds) of the same.
        images: a data set or its address: of the models, and of the controls.
        method: of clustering tables: "ward", "finch" or "k-means".
        counts: of the linear table: numbers of labelled rows to learn from.
        seeds: random training subsets; of segmentation runs of each net.
        finetune: of the linear table: also train models, ours and baselines', with the head.
        supervised: beside them a ResNet-18 with fresh weights, trained in the same way.
        masks, epochs: of segmentation: a folder of masks that are not with the images; of training.
        options: factors, seed, resamples, cache, ...: the fields of ``Options``.

    Raises:
        ValueError: an unknown table, or labels, factors or images that do not fit.
    """
    spec = named(TABLES, table, "table")
    how = Options.of(options, images=images, descriptors=table == "identity")
    given = {name: feature_rows.runs_of(runs) for name, runs in features.items()}
    models = {name: own for name, runs in given.items() if (own := list(filter(feature_rows.is_model, runs)))}
    numbers = {"table": table, "number": spec.number}
    if spec.kind == "segment":
        if images is None or isinstance(images, ImageSet) or not models or len(models) < len(features):
            what = f"table {table!r} trains nets from a model's encoders, and features do not do"
            raise ValueError(f"{what}: give models and the address of images that have masks")
        same: dict[str, Any] = {**options, "cache": how.memory, "masks": masks, "seeds": how.seeds(seeds)}
        settings = SegmentSettings(epochs=epochs)
        tables, values = [], {}
        for name, (model, *others) in models.items():
            if others:
                raise ValueError(f"two models have the name {name!r}: give each its own")
            result = segment(model, images, variants=PAPER_VARIANTS, settings=settings, **same)
            shown = (result.tables[-1], *result.tables[:-1])
            tables += [replace(one, caption=f"{name}: {one.caption}") for one in shown]
            more = {"differs": result.result.differs, "paper": spec.parts[0].paper}
            values[name] = {**result.result.numbers(), **more}
        return Scores(tables, {**numbers, "parts": values}, [how.memory.summary()])
    if masks is not None:
        raise ValueError(f"masks go with the table of segmentation, not with {table}")
    if finetune and (spec.kind != "linear" or not models):
        raise ValueError("finetune trains the encoders of models: give the linear table, models and images")
    if supervised and not finetune:
        raise ValueError("supervised is a row among fine-tuned models: give finetune, too")
    rows = [feature_rows.row_of(name, runs, how) for name, runs in given.items()]
    rows = feature_rows.with_controls(rows, how)
    first = rows[0].tables[0]
    parts = [part for part in spec.parts if part.columns(first)]
    if not parts:
        needed = " or ".join(", ".join(part.labels) for part in spec.parts)
        have = ", ".join(first.labels) or "none"
        raise ValueError(f"table {table!r} needs labels ({needed}), the features have {have}: embed others")
    tables, values, notes = [], {}, list(how.notes)
    for part in parts:
        columns = part.columns(first)
        if part.labels == (ATTRIBUTES,):
            least = 2 if spec.kind == "linear" else 1
            columns, left_out = feature_rows.chosen_labels(first, None, True, least)
            notes += left_out
        out = part.left_out(first)
        if out.any():
            notes.append(f"{part.name}: {out.sum():,} rows left out that are none of the paper's classes")
        kept = [replace(row, tables=tuple(one.select(~out) for one in row.tables)) for row in rows]
        try:
            ready = feature_rows.prepare(kept, columns, **part.rows(first))
        except ValueError as error:
            if part.size is None or len(parts) == 1:
                raise
            notes.append(f"{part.name} left out: {error}")
            continue
        layout = str(first.origin.get("layout", "unknown data"))
        beside = f"beside the paper's Table {spec.number}"
        more: dict[str, Any] = {"paper": part.paper}
        if spec.kind == "cluster":
            same = {**ready.asked, **how.scoring}
            result = compare_clusterings(method=method, **same)
            more |= {"n_dropped_before": ready.n_dropped, "differs": part.differs(layout, result.n_rows)}
            shown = {name: CLUSTER_COLUMNS[name] for name in ("accuracy", "f1")}
            scored = list(result.rows)
            if method == "ward":  # the paper's appendix has FINCH beside it
                try:
                    finch = compare_clusterings(method="finch", **same)
                except ValueError as error:  # its finest partition has fewer clusters than there are classes
                    notes.append(f"{part.name}: FINCH left out: {error}")
                else:
                    more["finch"] = finch.numbers()
                    likewise = (row for row in finch.rows if row.name in ready.features)
                    scored += [replace(row, name=f"{row.name}, FINCH") for row in likewise]
            caption = f"{part.name}, {beside} ({METHODS[method]})"
            last = {"intervals": (), "deviations": (), "more": interval_cells("accuracy", shown["accuracy"])}
            ours = scored_table(caption, "features", scored, shown, **last)
            tables.append(beside_the_paper(ours, (*shown, "interval"), part.paper, more["differs"]))
            tables += clustering_tables(result, f"{part.name}: above the strongest control?")
            if ready.n_dropped:
                beyond = "rows without a label or beyond its sizes left out"
                notes.append(f"{part.name}: {ready.n_dropped:,} {beyond}")
        else:
            also: dict[str, Any] = {"models": models if finetune else None, "supervised": supervised}
            result = compare_prepared(ready, counts, how.seeds(seeds), how, **also)
            more |= {"differs": part.differs(layout, len(ready.table))}
            caption = f"{part.name}: accuracy of the paper's head, {beside}"
            tables += [heads_table(caption, result, part.paper, more["differs"]), *linear_tables(result)]
        values[part.name] = {**result.numbers(), **more}
    return Scores(tables, {**numbers, "parts": values}, [*notes, how.memory.summary()])


def heads_table(
    caption: str, result: LinearComparison, paper: Sequence[PaperRow], differs: str
) -> ScoreTable:
    """Accuracies of the paper's head by number of labels, frozen and fine-tuned, over the paper's own."""
    columns, ours, controls = {}, {}, set()
    for part in result.parts:
        if part.head in ("linear", FINETUNED):
            key, how = f"{part.head} {part.count}", "frozen" if part.head == "linear" else part.head
            columns[key] = Column(f"{part.count:,} {how}", "high")
            for row in part.rows:
                ours.setdefault(row.name, {})[key] = row.scores["accuracy"].value
                controls |= {row.name} if row.control else set()
    lines: dict[str, dict[str, float]] = {}
    for line in paper:
        lines.setdefault(line.method, {}).update(line.scores)
    asked = {method: scores for method, scores in lines.items() if scores.keys() & columns.keys()}
    known = [PaperRow(method, paper[0].dataset, scores) for method, scores in asked.items()]
    rows = [Row(name, tuple(map(own.get, columns)), name in controls) for name, own in ours.items()]
    table = ScoreTable(caption, "features", tuple(columns.values()), rows)
    return beside_the_paper(table, tuple(columns), known, differs)
