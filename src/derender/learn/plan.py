"""A plan: images to learn from, methods, data sets to score, and how; from a YAML or TOML file.

Unknown names are errors with a suggestion, and every mistake that shows without images is found before
anything is trained.
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from derender.baselines import BASELINES, CONTROLS, TRAINED, baseline_config
from derender.data import suggestion
from derender.evaluation.paper_tables import TABLES
from derender.features import named
from derender.settings import Settings
from derender.storage.bounded import YAML_LIMIT, parse_yaml, read_text
from derender.training.config import as_overrides, config_from_tree, resolve

OURS = "derender"
KINDS = (OURS, *BASELINES)
ALWAYS_THERE = ("pixels", "pca", "untrained")  # every table has these controls
WITHOUT_LOOP = ("resnet18", "ris")  # trained, but not by the training loop: no number of images seen


def _methods(given: Any) -> Any:
    """A list of names, or names with nothing behind them, are methods by their kind."""
    if isinstance(given, list) and all(isinstance(name, str) for name in given):
        given = dict.fromkeys(given)
    return {name: one or {} for name, one in given.items()} if isinstance(given, dict) else given


ONE_OR_MANY = BeforeValidator(lambda one: (one,) if isinstance(one, str) else one)
Names = Annotated[tuple[str, ...], ONE_OR_MANY]


class ImageSource(Settings):
    """Where images are, and how they are read."""

    data: str
    dataset: str = "auto"
    limit: int | None = Field(default=None, ge=1)


class TrainingSet(ImageSource):
    """Images to learn from; all methods get the same ones."""

    split: tuple[float, float, float] = (0.8, 0.1, 0.1)  # train, validation, test


class Method(Settings):
    """One row of every table."""

    kind: str = ""  # derender or a baseline; by default the method's own name
    preset: str = "small"  # of derender
    settings: dict[str, Any] = Field(default_factory=dict)  # of its trainings, as --set key=value
    settings_on: dict[str, dict[str, Any]] = Field(default_factory=dict)  # further ones, by training set
    features: Names = ()  # which; by default geometry and albedo, or a baseline's first
    whitened: bool = True  # of derender: features as the model gives them, or its codes
    like: str | None = None  # another method whose runs this one takes instead of training its own
    runs: dict[str, str] = Field(default_factory=dict)  # by training set: an existing run folder
    model: str | None = None  # one trained model for all data sets: a folder, a name, a Hub id


class ScoredSet(ImageSource):
    """Images to score: by a table of the paper, or by labels."""

    trained_on: str | None = None  # training set of the methods that are scored here
    part: Literal["all", "train", "validation", "test"] = "all"  # of that training set's split
    protocols: Annotated[tuple[Literal["cluster", "linear"], ...], ONE_OR_MANY] = ("cluster",)
    table: str | None = None  # one of the paper's: identity, emotion, clustering, linear, cars
    label: Names = ()
    mean_by: Names = ()
    min_count: int = Field(default=1, ge=1)
    max_count: int | None = Field(default=None, ge=1)


class Plan(Settings):
    """A comparison, whole."""

    images: int = Field(default=20_000, ge=1)  # images that every training sees, repeats counted
    settings: dict[str, Any] = Field(default_factory=dict)  # of every training in the loop, as --set
    seeds: int = Field(default=1, ge=1)  # trainings of each method, on each training set
    image_size: int = Field(default=64, ge=8)  # of methods without a network of a fixed size
    train: dict[str, TrainingSet] = Field(default_factory=dict)
    methods: Annotated[dict[str, Method], BeforeValidator(_methods)] = Field(default_factory=dict)
    score: dict[str, ScoredSet] = Field(default_factory=dict)
    clustering: Literal["ward", "finch", "k-means"] = "ward"
    counts: tuple[int, ...] = (100, 500, 1_000)  # labelled rows of the linear protocol
    draws: int = Field(default=5, ge=1)  # random subsets of these rows
    untrained_seeds: int = Field(default=3, ge=1)
    resamples: int = Field(default=1_000, ge=2)

    def source(self, name: str) -> str:
        """The method whose runs this one uses: mostly itself."""
        return self.methods[name].like or name

    def kind(self, name: str) -> str:
        """``derender`` or a baseline's name."""
        kind = self.methods[self.source(name)].kind or self.source(name)
        return OURS if kind == "ours" else kind

    def is_trained(self, name: str) -> bool:
        """Whether it has a run for each training set."""
        return self.kind(name) in (OURS, *TRAINED) and self.methods[self.source(name)].model is None

    def rows(self) -> list[str]:
        """Methods that need features of their own: all but the controls that every table has."""
        return [name for name in self.methods if self.kind(name) not in ALWAYS_THERE]

    def configuration(self, name: str, trained_on: str, seed: int) -> Any:
        """The settings of one training."""
        kind, method = self.kind(name), self.methods[name]
        tree = {**method.settings, **method.settings_on.get(trained_on, {})}
        if kind not in WITHOUT_LOOP:
            tree = {**self.settings, **tree, "images": self.images}
        changes = as_overrides({**tree, "split": self.train[trained_on].split, "seed": seed})
        return resolve(method.preset, changes) if kind == OURS else baseline_config(kind, changes)


def read_plan(path: str | Path) -> Plan:
    """The plan in a YAML or TOML file.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it cannot be read, or something in it does not fit; says where and what to do.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no plan at {path}: give --plan the name of a YAML or TOML file")
    try:
        text = read_text(path, YAML_LIMIT)
        tree = tomllib.loads(text) if path.suffix == ".toml" else parse_yaml(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as a plan: {error}") from error
    try:
        if not isinstance(tree, dict):
            raise ValueError("it should have methods: and score:")
        plan = config_from_tree(tree, Plan)
        for fault in _faults(plan):
            raise ValueError(fault)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return plan


def _faults(plan: Plan) -> Iterator[str]:
    """What in a plan does not fit the rest of it."""
    if not (plan.methods and plan.score):
        yield "a plan needs at least one of methods: and one of score:"
    for name in (*plan.train, *plan.methods, *plan.score):
        if not name or set(name) & set('/\\:*?"<>|') or name.startswith("."):
            yield f"the name {name!r} cannot be a folder's: leave out / \\ : * ? and the like"
    for name, method in plan.methods.items():
        own = bool(method.settings or method.settings_on or method.runs)
        if (like := method.like) is not None:
            if named(plan.methods, like, "like").like is not None:
                yield f"method {name!r} is like {like!r}, which is like another: name that one"
            if own or method.kind or method.model:
                yield f"method {name!r} is like {like!r}: it takes features and whitened alone"
        if (kind := plan.kind(name)) not in KINDS:
            yield f"method {name!r} is of no known kind{suggestion(kind, KINDS)}: choose {', '.join(KINDS)}"
        for where in (*method.runs, *method.settings_on):
            named(plan.train, where, "training set")
        given = [plan.settings, method.settings, *method.settings_on.values()]
        for key in ("images", "split", "seed"):
            if any(key in one for one in given):
                yield f"{key} is the plan's own and the same for all: not in settings of {name!r}"
        if own and kind not in (OURS, *TRAINED):
            yield f"method {name!r} ({kind}) is not trained here: leave settings and runs out"
        if method.model is not None and (kind in CONTROLS or method.runs):
            yield f"method {name!r}: model is one trained network; leave it or runs out"
    for name, scored in plan.score.items():
        yield from _score_faults(plan, f"score {name!r}", scored)


def _score_faults(plan: Plan, name: str, scored: ScoredSet) -> Iterator[str]:
    if (scored.table is None) == (not scored.label):
        yield f"{name} needs a table (identity, emotion, ...) or a label, not both"
    if scored.table is not None:
        if named(TABLES, scored.table, "table").kind == "segment":
            yield f"{name}: segmentation trains nets of its own: use derender compare --table segmentation"
        if scored.mean_by or scored.min_count > 1 or scored.max_count is not None:
            yield f"{name}: mean_by, min_count and max_count go with label, not with table"
    trained = [method for method in plan.rows() if plan.is_trained(method)]
    if scored.trained_on is None:
        if trained:
            yield f"{name} needs trained_on: {trained[0]!r} has to learn from something"
        if scored.part != "all":
            yield f"{name}: part {scored.part} is of a training set: give trained_on"
        return
    learnt = named(plan.train, scored.trained_on, "training set")
    if scored.part != "all":
        if (scored.data, scored.dataset, scored.limit) != (learnt.data, learnt.dataset, learnt.limit):
            other = f"the images of {scored.trained_on!r}: give the same data, dataset and limit"
            yield f"{name}: part {scored.part} is of {learnt.data}, {other}"
        if plan.seeds > 1:
            yield f"{name}: every seed splits anew, so part goes with seeds: 1"
    for method in trained:
        if plan.methods[method].like is None and scored.trained_on not in plan.methods[method].runs:
            plan.configuration(method, scored.trained_on, 0)  # raises where a setting does not fit
