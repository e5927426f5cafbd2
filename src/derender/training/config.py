"""How a model is trained: one place for every default, one row per preset, strict about names.

Source: the paper, Sec. 4 and its published settings; where the two differ (learning rate 1e-3 in the text,
1e-4 with weight decay 5e-4 in the settings) the settings hold, because the larger rate collapses.
"""

import json
from collections.abc import Iterable, Mapping
from reprlib import Repr
from typing import Any, Literal, TypeVar, overload

import yaml
from pydantic import Field, ValidationError, field_validator

from derender.data import suggestion
from derender.model import load
from derender.postprocess.fitting import FittingSettings
from derender.presets import MODEL_PRESETS, ModelSettings, named_preset
from derender.scene.crop import DEFAULT_CROPS, CropSettings
from derender.scene.perturb import PerturbSettings
from derender.settings import Settings

LooccKind = Literal["none", "light", "light+camera", "all"]

LOOCC_FACTORS: dict[str, tuple[str, ...]] = {
    "none": (),
    "light": ("light",),
    "light+camera": ("light", "camera"),
    "all": ("geometry", "albedo", "light", "camera"),
}


class ObjectiveSettings(Settings):
    """What is minimised: reconstruction of the picture by a scene and by its flipped twin, plus LOOCC."""

    flip_weight: float = Field(default=0.5, ge=0)
    confidence: bool = True
    perceptual: Literal["vgg16", "self", "none"] = "self"
    perceptual_weight: float = Field(default=1.0, ge=0)
    smoothness_weight: float = Field(default=0.0, ge=0)  # on steps of depth, as unsup3d for cars
    curvature_weight: float = Field(default=3.0, ge=0)  # on second differences of depth; ours, 0 in the paper
    vgg16_path: str | None = None  # None: the file torch hub keeps
    self_features_steps: int = Field(default=600, ge=1)
    loocc: LooccKind = "none"
    loocc_weight: float = Field(default=0.01, ge=0)
    loocc_temperature: float = Field(default=0.5, gt=0)
    loocc_after: float = Field(default=0.0, ge=0, le=1)  # share of the run before LOOCC and its cycle; ours
    cycle_weight: float = Field(default=0.0, ge=0)  # light and camera read back from LOOCC's renderings; ours
    template_share: float = Field(default=0.0, ge=0, le=1)  # of the run: all share one shape and albedo; ours
    release_share: float = Field(default=0.0, ge=0, le=1)  # of the run: each gets its own bit by bit
    perturb: PerturbSettings = PerturbSettings()


class WhiteningSettings(Settings):
    """How codes become features after training (postprocess/whitening.py); 0 pictures: features are codes."""

    pictures: int = Field(default=3_000, ge=0)  # training pictures that are rendered again
    views: int = Field(default=4, ge=1)  # renderings of each
    spatial: bool = True  # read the encoder's last spatial features beside the code
    mirrored: bool = True  # read the picture's mirror image beside it
    directions: int = Field(default=128, ge=1)  # kept of geometry and albedo each, at most the code's size
    shrinkage: float = Field(default=0.1, ge=0)  # share of the mean variance added to every direction's
    evenness: float = Field(default=0.5, ge=0, le=1)  # 0: what tells pictures apart best counts most
    vectors: bool = True  # light and camera have features of their own; else those are their codes
    vector_power: float = Field(default=3.0, ge=0)  # of repeatability, by which their directions are weighted
    frames: int = Field(default=0, ge=0)  # times each picture is also shown in another frame
    reframe: CropSettings = DEFAULT_CROPS


class FeatureSettings(Settings):
    """What `derender whiten` can be told: how features are fitted, and what is changed for it."""

    whitening: WhiteningSettings = WhiteningSettings()
    fitting: FittingSettings = FittingSettings()
    perturb: PerturbSettings = PerturbSettings()


class OptimiserSettings(Settings):
    """Adam with weight decay, after a linear warm-up; ``final_rate`` < 1 lets it fall along a cosine."""

    learning_rate: float = Field(default=1e-4, gt=0)
    final_rate: float = Field(default=1.0, gt=0, le=1)  # share of learning_rate at the end
    weight_decay: float = Field(default=5e-4, ge=0)
    warmup_images: int = Field(default=0, ge=0)
    betas: tuple[float, float] = (0.9, 0.999)


class LoopSettings(Settings):
    """What every run of the training loop has, whatever it trains."""

    optimiser: OptimiserSettings = OptimiserSettings()
    batch_size: int = Field(default=64, ge=2)
    images: int = Field(default=600_000, ge=1)  # pictures seen in the whole run, repeats counted
    minutes: float | None = Field(default=None, gt=0)  # stop earlier once training has taken this long
    validate_every: int = Field(default=20_000, ge=1)  # pictures between validations
    sample_every: int = Field(default=20_000, ge=1)  # pictures between sample sheets
    checkpoint_every: int = Field(default=20_000, ge=1)  # pictures between checkpoints
    patience: int = Field(default=10, ge=1)  # validations without improvement before stopping
    keep: Literal["best", "last"] = "best"  # the model: of the best validation, or of the last checkpoint
    horizontal_flips: bool = True
    reframed: float = Field(default=0.0, ge=0, le=1)  # share of the pictures shown in another frame
    reframe: CropSettings = DEFAULT_CROPS
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)  # train, validation, test
    precision: Literal["32-true", "bf16-mixed"] = "32-true"  # networks only; geometry is always float32
    channels_last: bool = True
    deterministic: bool = False
    watch: bool = True  # look for collapse and return to the last good checkpoint
    seed: int = 0


class TrainConfig(LoopSettings):
    """One training run of our model, whole."""

    preset: str = "faces"
    start_from: str | None = None  # a trained model whose weights the run begins with
    accumulate: int = Field(default=1, ge=1)  # chunks of a batch: less memory, same losses, slower
    model: ModelSettings = ModelSettings()
    objective: ObjectiveSettings = ObjectiveSettings()
    whitening: WhiteningSettings = WhiteningSettings()
    fitting: FittingSettings = FittingSettings()

    @field_validator("model")
    @classmethod
    def _without_decoder(cls, value: ModelSettings) -> ModelSettings:
        if value.network.unet_decoder:
            raise ValueError("network.unet_decoder: rendering trains none, derender unet teaches one")
        return value

    @property
    def features(self) -> FeatureSettings:
        """How features are made once training has ended."""
        return FeatureSettings(whitening=self.whitening, fitting=self.fitting, perturb=self.objective.perturb)


Config = TypeVar("Config", bound=Settings)

_SHORT = Repr()
_SHORT.maxstring = _SHORT.maxother = 200  # a few lines of YAML can stand for gigabytes of text


def _preset(name: str, **changes: Any) -> TrainConfig:
    return TrainConfig(preset=name, model=MODEL_PRESETS[name], **changes)


PRESETS: dict[str, TrainConfig] = {
    "paper": _preset(
        "paper",
        objective=ObjectiveSettings(perceptual="vgg16", curvature_weight=0.0),
        whitening=WhiteningSettings(pictures=0),
    ),
    "faces": _preset("faces"),
    "cats": _preset("cats"),
    "cars": _preset(
        "cars",
        batch_size=256,
        objective=ObjectiveSettings(
            flip_weight=1.0, confidence=False, perceptual_weight=0.01, smoothness_weight=0.1
        ),
    ),
    "small": _preset(
        "small",
        batch_size=16,
        images=250_000,
        optimiser=OptimiserSettings(learning_rate=3e-4, warmup_images=4_000, final_rate=0.05),
    ),
}


def resolve(preset: str, overrides: Iterable[str] = (), **explicit: Any) -> TrainConfig:
    """The configuration of a run: a preset, then ``key=value`` overrides, then explicit dotted keys.

    Keys are dotted (``optimiser.learning_rate``); a unique last part may stand alone (``learning_rate``).
    Values are read as YAML. In ``explicit`` dots are written as double underscores and None means not given.
    With ``start_from`` the model is that model's (a taught decoder aside), not the preset's, before overrides
    change it.

    Raises:
        ValueError: unknown preset or key (names the nearest), or a value that does not fit.
        FileNotFoundError: there is no model to start from.
    """
    overrides = list(overrides)
    config = with_changes(named_preset(preset, PRESETS), overrides, **explicit)
    if config.start_from is None:
        return config
    model = load(config.start_from).settings
    model = model.model_copy(update={"network": model.network.model_copy(update={"unet_decoder": False})})
    row = named_preset(preset, PRESETS).model_copy(update={"model": model})
    return with_changes(row, overrides, **explicit)


def with_changes(config: Config, overrides: Iterable[str] = (), **explicit: Any) -> Config:
    """The same kind of configuration with changes as in ``resolve``."""
    tree = config.model_dump(mode="json")
    changes: list[tuple[str, Any]] = []
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ValueError(f"cannot read {override!r}: write key=value, for example learning_rate=2e-4")
        changes.append((key.strip(), _read_value(text)))
    changes += [(key.replace("__", "."), value) for key, value in explicit.items() if value is not None]
    for key, value in changes:
        _assign(tree, _full_key(key, tree), value)
    return config_from_tree(tree, type(config))


@overload
def config_from_tree(tree: Mapping[str, Any]) -> TrainConfig: ...
@overload
def config_from_tree(tree: Mapping[str, Any], kind: type[Config]) -> Config: ...
def config_from_tree(tree: Mapping[str, Any], kind: type[Settings] = TrainConfig) -> Settings:
    """Check plain values (from YAML or JSON) and give the configuration, or one clear error."""
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise ValueError(f"unknown setting {key!r}{suggestion(key, setting_names(kind))}") from error
        raise ValueError(f"setting {key!r}: {first['msg']}, got {_SHORT.repr(first['input'])}") from error


def to_yaml(config: Settings) -> str:
    """The whole configuration as YAML, in the order of its definition."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def as_overrides(tree: Mapping[str, Any]) -> list[str]:
    """Plain values, nested or with dotted keys, as the ``key=value`` that ``with_changes`` takes."""
    return [f"{key}={json.dumps(value)}" for key, value in _leaves(tree).items()]


def setting_names(kind: type[Settings] = TrainConfig) -> list[str]:
    """Every setting by its dotted name."""
    return list(_leaves(kind().model_dump(mode="json")))


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        found |= _leaves(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return found


def _full_key(key: str, tree: Mapping[str, Any]) -> str:
    names = list(_leaves(tree))
    if key in names:
        return key
    ending = [name for name in names if name.rsplit(".", 1)[-1] == key or name.endswith(f".{key}")]
    if len(ending) == 1:
        return ending[0]
    if ending:
        raise ValueError(f"{key!r} could mean {' or '.join(ending)}: write it in full")
    short = {name.rsplit(".", 1)[-1]: name for name in names}
    guess = suggestion(key, names) or suggestion(key.rsplit(".", 1)[-1], short)
    raise ValueError(f"unknown setting {key!r}{guess}: 'derender train --dry-run' lists all of them")


def _assign(tree: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    for parent in parents:
        tree = tree[parent]
    tree[last] = value


def _read_value(text: str) -> Any:
    """YAML, and numbers such as 1e-4 that YAML 1.1 takes for words."""
    try:
        value = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(
            f"cannot read the value {text!r}: write a number, a word, true, false or [a, b]"
        ) from error
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value
