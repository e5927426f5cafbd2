"""One scored set of a plan: every question asked of the features of all methods at once, beside controls."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from derender.cli import feature_rows
from derender.cli.console import plain
from derender.cli.plan.embedding import scored_pictures
from derender.cli.plan.jobs import Job, Note, Place
from derender.cli.plan.settings import OURS, Plan
from derender.evaluation.feature_rows import attribute_columns
from derender.evaluation.memory import Memory, content_hash
from derender.evaluation.paper_tables import ATTRIBUTES, RowRules, table_named

if TYPE_CHECKING:
    from derender.evaluation.feature_rows import FeatureRow
    from derender.features import FeatureTable


@dataclass(frozen=True)
class Question:
    """One question of a scored set: label columns, and which rows are asked.

    Attributes:
        name: of the scored set, and of the question where it has several.
        columns: the labels.
        rules: which rows.
    """

    name: str
    columns: tuple[str, ...]
    rules: RowRules


def scoring_key(plan: Plan, job: Job, notes: dict[Job, Note]) -> str:
    """Changes with any method's features, and with how they are scored."""
    how = plan.model_dump(
        mode="json", include={"clustering", "counts", "draws", "untrained_seeds", "resamples", "image_size"}
    )
    scored = plan.score[job.where].model_dump(mode="json")
    features = [[one.method, one.seed, notes[one].key, notes[one].state] for one in job.after]
    return content_hash({"how": how, "scored": scored, "features": features})


def questions(plan: Plan, name: str, table: "FeatureTable") -> list[Question]:
    """What is asked of a scored set, by the labels it has.

    Raises:
        ValueError: it has none of the labels.
    """
    scored = plan.score[name]
    if scored.table is None:
        columns = attribute_columns(table) if scored.label == (ATTRIBUTES,) else scored.label
        if not columns:
            raise ValueError(f"{scored.data} has no yes/no label; it has {', '.join(table.labels) or 'none'}")
        for column in (*columns, *scored.mean_by):
            table.label(column)
        rules = RowRules(scored.mean_by, scored.min_count, scored.max_count)
        return [Question(name, tuple(columns), rules)]
    parts = [part for part in table_named(scored.table).parts if part.columns(table)]
    if not parts:
        have = ", ".join(table.labels) or "none"
        raise ValueError(f"table {scored.table!r} needs other labels than {scored.data} has ({have})")
    several = len(parts) > 1
    return [
        Question(f"{name} {part.name}" if several else name, part.columns(table), part.rows(table))
        for part in parts
    ]


def score_job(plan: Plan, place: Place, job: Job, *, device: str) -> Note:
    """Score what is there; methods without features are left out (their own notes say why)."""
    from derender.features import FeatureTable

    notes = {one: note for one in job.after if (note := place.note(one)) is not None}
    memory, rows = Memory(place.memory), []
    for method in plan.rows():
        done = [one for one in job.after if one.method == method and notes[one].state == "done"]
        if done:
            tables = tuple(FeatureTable.read(place.features(one)) for one in done)
            control = "control" in tables[0].origin
            rows.append(_row(method, tables, tuple(notes[done[0]].facts["factors"]), control))
    controls, parameters = _controls(plan, job.where, rows, device, memory)
    facts = {
        row.name: {
            "numbers": int(row.tables[0].concatenate(row.factors).shape[1]),
            "parameters": parameters if row.name.startswith("untrained") else None,
        }
        for row in controls
    }
    rows += controls
    found = []
    for question in questions(plan, job.where, rows[0].tables[0]):
        for protocol in plan.score[job.where].protocols:
            found.append({"name": question.name, **plain(_ask(plan, question, protocol, rows, memory))})
    return Note(scoring_key(plan, job, notes), "done", facts={"questions": found, "controls": facts})


def _row(name: str, tables: Any, factors: tuple[str, ...], control: bool) -> "FeatureRow":
    from derender.evaluation.feature_rows import FeatureRow

    return FeatureRow(name, tables, factors, control)


def _controls(
    plan: Plan, where: str, rows: "list[FeatureRow]", device: str, memory: Memory
) -> "tuple[list[FeatureRow], int]":
    """Untrained encoders of our own architecture, PCA and pixels; and the parameters of the first."""
    from derender.model import Derenderer
    from derender.presets import MODEL_PRESETS

    scored = plan.score[where]
    pictures = scored_pictures(scored, plan, plan.image_size)
    if rows:
        pictures = feature_rows.aligned(pictures, rows[0].tables[0].files)
    network = MODEL_PRESETS["small"].network.model_copy(update={"image_size": plan.image_size})
    settings: Any = MODEL_PRESETS["small"].model_copy(update={"network": network})
    own = [name for name in plan.rows() if plan.kind(name) == OURS and plan.is_trained(name)]
    if own and scored.trained_on is not None:
        mine = plan.configuration(plan.source(own[0]), scored.trained_on, 0).model
        settings = mine if mine.network.image_size == plan.image_size else settings
    seeds = range(plan.untrained_seeds)
    factors = ("geometry", "albedo")
    controls = feature_rows.control_rows(pictures, settings, factors, seeds, device, memory)
    return controls, sum(values.numel() for values in Derenderer.seeded(settings, 0).parameters())


def _ask(
    plan: Plan, question: Question, protocol: str, rows: "list[FeatureRow]", memory: Memory
) -> dict[str, Any]:
    from derender.evaluation.clustering import compare_clusterings
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.linear_probing import compare_prepared

    ready = prepare(rows, question.columns, **asdict(question.rules))
    if protocol == "cluster":
        found: Any = compare_clusterings(
            ready.features,
            ready.labels,
            controls=ready.controls,
            method=plan.clustering,
            resample_count=plan.resamples,
            memory=memory,
        )
        numbers = found.numbers()
        numbers.pop("per_label")
        return {"protocol": protocol, **numbers}
    draws = tuple(range(plan.draws))
    found = compare_prepared(ready, plan.counts, draws, resample_count=plan.resamples, memory=memory)
    return {"protocol": protocol, **found.numbers()}
