"""A plan: images to learn from, methods, data sets to score, and how; from a YAML or TOML file.

Unknown names are errors with a suggestion, and every mistake that shows without images is found before
anything is trained.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, StringConstraints

from derender.baselines import BASELINES, CONTROLS, TRAINED, baseline_config
from derender.evaluation.options import COUNTS
from derender.features import named
from derender.overrides import checked
from derender.settings import ONE_OR_MANY, Names, Settings
from derender.storage.bounded import YAML_LIMIT, parse_yaml, read_text
from derender.training.config import as_overrides, resolve

OURS = "derender"
KINDS = {kind: kind for kind in (OURS, *BASELINES)} | {"ours": OURS}
ALWAYS_THERE = ("pixels", "pca", "untrained")  # every table has these controls
WITHOUT_LOOP = ("resnet18", "ris")  # trained, but not by the training loop: no number of images seen


def _methods(given: Any) -> Any:
    """A list of names, or names with nothing behind them, are methods by their kind."""
    if isinstance(given, list) and all(isinstance(name, str) for name in given):
        given = dict.fromkeys(given)
    return {name: one or {} for name, one in given.items()} if isinstance(given, dict) else given


Name = Annotated[str, StringConstraints(pattern=r'^[^/\\:*?"<>|.][^/\\:*?"<>|]*$')]  # a folder's, too


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
    table: Literal["clustering", "identity", "emotion", "linear", "cars"] | None = None  # of the paper
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
    train: dict[Name, TrainingSet] = Field(default_factory=dict)
    methods: Annotated[dict[Name, Method], BeforeValidator(_methods)] = Field(default_factory=dict)
    score: dict[Name, ScoredSet] = Field(default_factory=dict)
    clustering: Literal["ward", "finch", "k-means"] = "ward"
    counts: tuple[int, ...] = COUNTS  # labelled rows of the linear protocol
    draws: int = Field(default=5, ge=1)  # random subsets of these rows
    untrained_seeds: int = Field(default=3, ge=1)
    resamples: int = Field(default=1_000, ge=2)

    def source(self, name: str) -> str:
        """The method whose runs this one uses: mostly itself."""
        return self.methods[name].like or name

    def kind(self, name: str) -> str:
        """``derender`` or a baseline's name; another is a ValueError."""
        source = self.source(name)
        return named(KINDS, named(self.methods, source, "like").kind or source, "kind of method")

    def is_trained(self, name: str) -> bool:
        """Whether it has a run for each training set."""
        return self.kind(name) in (OURS, *TRAINED) and self.methods[self.source(name)].model is None

    def rows(self) -> list[str]:
        """Methods that need features of their own: all but the controls that every table has."""
        return [name for name in self.methods if self.kind(name) not in ALWAYS_THERE]

    def configuration(self, name: str, trained_on: str, seed: int) -> Any:
        """The settings of one training; one that does not fit is a ValueError."""
        kind, method = self.kind(name), self.methods[name]
        tree = {**method.settings, **method.settings_on.get(trained_on, {})}
        if own := {"images", "split", "seed"} & {*self.settings, *tree}:
            raise ValueError(f"{min(own)} is the plan's own, the same for all: not in settings of {name!r}")
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
        plan = checked(tomllib.loads(text) if path.suffix == ".toml" else parse_yaml(text), Plan)
        _check(plan)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as a plan: {error}") from error
    return plan


def _check(plan: Plan) -> None:
    """A ValueError where something in a plan does not fit the rest of it."""
    if not (plan.methods and plan.score):
        raise ValueError("a plan needs at least one of methods: and one of score:")
    for name, method in plan.methods.items():
        kind, learns = plan.kind(name), {"settings", "settings_on", "runs"}
        if plan.methods[plan.source(name)].like is not None:
            raise ValueError(f"method {name!r} is like {method.like!r}, which is like another: name that one")
        why, barred = f"({kind}) is not trained here", {*learns, "model"} if kind in CONTROLS else learns
        if method.like is not None:
            why, barred = f"is like {method.like!r}", {*learns, "model", "kind"}
        elif plan.is_trained(name):
            barred = set()
        if extra := sorted(barred & method.model_fields_set):
            raise ValueError(f"method {name!r} {why}: leave out {', '.join(extra)}")
        for where in (*method.runs, *method.settings_on):
            named(plan.train, where, "training set")
    trained = [method for method in plan.rows() if plan.is_trained(method)]
    for name, scored in plan.score.items():
        where, part, needs = scored.trained_on, scored.part != "all", f"score {name!r} needs"
        if (scored.table is None) == (not scored.label):
            raise ValueError(f"{needs} a table (identity, emotion, ...) or a label, not both")
        if where is None:
            if trained or part:
                whose = ", ".join(trained) or "its part"
                raise ValueError(f"{needs} trained_on: the training set of {whose}")
            continue
        learnt = named(plan.train, where, "training set")
        same = all(getattr(scored, key) == getattr(learnt, key) for key in ImageSource.model_fields)
        if part and (not same or plan.seeds > 1):
            raise ValueError(f"{needs} seeds: 1 and the data, dataset and limit of {where!r} for its part")
        for method in trained:
            if plan.methods[method].like is None and where not in plan.methods[method].runs:
                plan.configuration(method, where, 0)  # raises where a setting does not fit
