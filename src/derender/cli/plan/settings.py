"""A plan file: images to learn from, methods, data sets to score, and how.

A plan is YAML or TOML. Unknown names are errors with a suggestion, and every mistake that shows without
images is found before anything is trained.
"""

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BeforeValidator, Field, field_validator

from derender.baselines import baseline_config
from derender.baselines.registry import BASELINES, CONTROLS, TRAINED
from derender.data import suggestion
from derender.evaluation.paper_tables import table_named
from derender.settings import Settings
from derender.training.config import config_from_tree, resolve

OURS = "derender"
KINDS = (OURS, *BASELINES)
ALWAYS_THERE = ("pixels", "pca", "untrained")  # every table has these controls
WITHOUT_LOOP = ("resnet18", "ris")  # trained, but not by the training loop: no number of images seen
RESERVED = ("images", "split", "seed")  # the plan's own

ONE_OR_MANY = BeforeValidator(lambda one: (one,) if isinstance(one, str) else one)
Names = Annotated[tuple[str, ...], ONE_OR_MANY]


class TrainingSet(Settings):
    """Images to learn from; all methods get the same ones."""

    data: str
    dataset: str = "auto"
    limit: int | None = Field(default=None, ge=1)
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


class ScoredSet(Settings):
    """Images to score: by a table of the paper, or by labels."""

    data: str
    dataset: str = "auto"
    limit: int | None = Field(default=None, ge=1)
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
    methods: dict[str, Method] = Field(default_factory=dict)
    score: dict[str, ScoredSet] = Field(default_factory=dict)
    clustering: Literal["ward", "finch", "k-means"] = "ward"
    counts: tuple[int, ...] = (100, 500, 1_000)  # labelled rows of the linear protocol
    draws: int = Field(default=5, ge=1)  # random subsets of these rows
    untrained_seeds: int = Field(default=3, ge=1)
    resamples: int = Field(default=1_000, ge=2)

    @field_validator("methods", mode="before")
    @classmethod
    def _named(cls, value: object) -> object:
        """A list of names, or names with nothing behind them, are methods by their kind."""
        if isinstance(value, list) and all(isinstance(name, str) for name in value):
            value = dict.fromkeys(value)
        if isinstance(value, dict):
            return {name: {} if method is None else method for name, method in value.items()}
        return value

    def kind(self, name: str) -> str:
        """``derender`` or a baseline's name."""
        method = self.methods[name]
        if method.like is not None:
            return self.kind(method.like)
        return OURS if (method.kind or name) == "ours" else method.kind or name

    def source(self, name: str) -> str:
        """The method whose runs this one uses: mostly itself."""
        return self.methods[name].like or name

    def is_trained(self, name: str) -> bool:
        """Whether it has a run for each training set."""
        return self.kind(name) in (OURS, *TRAINED) and self.methods[self.source(name)].model is None

    def rows(self) -> list[str]:
        """Methods that need features of their own: all but the controls that every table has."""
        return [name for name in self.methods if self.kind(name) not in ALWAYS_THERE]

    def configuration(self, name: str, trained_on: str, seed: int) -> Any:
        """The settings of one training."""
        kind, method = self.kind(name), self.methods[name]
        own = {**method.settings, **method.settings_on.get(trained_on, {})}
        common: dict[str, Any] = {"split": self.train[trained_on].split, "seed": seed}
        if kind not in WITHOUT_LOOP:
            common |= {"images": self.images}
            own = {**self.settings, **own}
        changes = [f"{key}={json.dumps(value)}" for key, value in {**own, **common}.items()]
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
        text = path.read_text(encoding="utf-8")
        tree = tomllib.loads(text) if path.suffix == ".toml" else yaml.safe_load(text)
    except (yaml.YAMLError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read as a plan: {error}") from error
    if not isinstance(tree, dict):
        raise ValueError(f"{path} is no plan: it should have methods: and score:")
    try:
        plan = config_from_tree(tree, Plan)
        check(plan)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return plan


def check(plan: Plan) -> None:
    """Parts of a plan that do not fit together are an error, before anything is done."""
    if not plan.methods or not plan.score:
        raise ValueError("a plan needs at least one of methods: and one of score:")
    for name in (*plan.train, *plan.methods, *plan.score):
        if not name or set(name) & set('/\\:*?"<>|') or name.startswith("."):
            raise ValueError(f"the name {name!r} cannot be a folder's: leave out / \\ : * ? and the like")
    for name, method in plan.methods.items():
        _check_method(plan, name, method)
    for name, scored in plan.score.items():
        _check_scored(plan, name, scored)
    used = {scored.trained_on for scored in plan.score.values()}
    for name in plan.rows():
        if plan.is_trained(name) and plan.source(name) == name:
            for trained_on in used & plan.train.keys() - plan.methods[name].runs.keys():
                plan.configuration(name, str(trained_on), 0)


def _check_method(plan: Plan, name: str, method: Method) -> None:
    own = bool(method.settings or method.settings_on or method.runs)
    if method.like is not None:
        _known("like", method.like, plan.methods)
        if plan.methods[method.like].like is not None:
            raise ValueError(f"method {name!r} is like {method.like!r}, which is like another: name that one")
        if own or method.kind or method.model:
            raise ValueError(f"method {name!r} is like {method.like!r}: it takes features and whitened alone")
    kind = plan.kind(name)
    if kind not in KINDS:
        choices = ", ".join(KINDS)
        raise ValueError(f"method {name!r} is of no known kind{suggestion(kind, KINDS)}: choose {choices}")
    for where in (*method.runs, *method.settings_on):
        _known("training set", where, plan.train)
    for settings in (plan.settings, method.settings, *method.settings_on.values()):
        for key in set(RESERVED) & settings.keys():
            raise ValueError(f"{key} is the plan's own and the same for all: not in settings of {name!r}")
    if own and kind not in (OURS, *TRAINED):
        raise ValueError(f"method {name!r} ({kind}) is not trained here: leave settings and runs out")
    if method.model is not None and (kind in CONTROLS or method.runs):
        raise ValueError(f"method {name!r}: model is one trained network; leave it or runs out")


def _check_scored(plan: Plan, name: str, scored: ScoredSet) -> None:
    if (scored.table is None) == (not scored.label):
        raise ValueError(f"score {name!r} needs a table (identity, emotion, ...) or a label, not both")
    if scored.table is not None:
        if table_named(scored.table).kind == "segment":
            raise ValueError(
                f"score {name!r}: segmentation trains nets of its own: use derender compare --table "
                "segmentation"
            )
        if scored.mean_by or scored.min_count > 1 or scored.max_count is not None:
            raise ValueError(
                f"score {name!r}: mean_by, min_count and max_count go with label, not with table"
            )
    needing = [method for method in plan.rows() if plan.is_trained(method)]
    if scored.trained_on is None:
        if needing:
            raise ValueError(f"score {name!r} needs trained_on: {needing[0]!r} has to learn from something")
        if scored.part != "all":
            raise ValueError(f"score {name!r}: part {scored.part} is of a training set: give trained_on")
        return
    _known("training set", scored.trained_on, plan.train)
    learnt = plan.train[scored.trained_on]
    if scored.part != "all":
        if (scored.data, scored.dataset, scored.limit) != (learnt.data, learnt.dataset, learnt.limit):
            raise ValueError(
                f"score {name!r}: part {scored.part} is of {learnt.data}, the images of "
                f"{scored.trained_on!r}: give the same data, dataset and limit"
            )
        if plan.seeds > 1:
            raise ValueError(f"score {name!r}: every seed splits anew, so part goes with seeds: 1")


def _known(what: str, name: str, names: Any) -> None:
    if name not in names:
        known = ", ".join(names) or "none"
        raise ValueError(f"unknown {what} {name!r}{suggestion(name, names)}; there is {known}")
