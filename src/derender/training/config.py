"""How a model is trained: one place for every default, one row per preset, strict about names.

Source: the paper, Sec. 4 and its published settings. Where the two differ the settings hold: learning rate
1e-4 with weight decay 5e-4. The text's 1e-3 collapses.
"""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import yaml
from pydantic import Field, field_validator

from derender.data import suggestion
from derender.model import load
from derender.networks.factors import GEOMETRY_START, Factor
from derender.overrides import SHORT, settings_by_name, with_changes
from derender.postprocess.fitting import FittingSettings
from derender.presets import MODEL_PRESETS, ModelSettings, named_preset
from derender.renderers import renderer_named
from derender.scene.perturb import PerturbSettings
from derender.settings import Settings
from derender.storage.bounded import table_beside


def loocc_factors(kind: str, factors: Iterable[Factor]) -> list[Factor]:
    """The factors that a kind of LOOCC perturbs: "none", "all", or names joined by +; else a ValueError."""
    able = {factor.name: factor for factor in factors if factor.perturb is not None}
    asked = {"none": (), "all": able}.get(kind, kind.split("+"))
    for name in asked:
        if name not in able:
            what = f"setting 'objective.loocc': {name!r} is no factor that this model perturbs"
            fix = f"write none, all, or some of {', '.join(able)} joined by +, such as light+camera"
            raise ValueError(f"{what}{suggestion(name, able)}: {fix}")
    return [factor for name, factor in able.items() if name in asked]


class ObjectiveSettings(Settings):
    """The loss: reconstruction of the image by a scene and by its flipped twin, plus LOOCC."""

    flip_weight: float = Field(default=0.5, ge=0)  # of the reconstruction from mirrored maps
    confidence: bool = True  # predict the error of each pixel (sigma)
    perceptual: Literal["vgg16", "self", "none"] = "self"  # features: VGG16's, learned on the images, or none
    perceptual_weight: float = Field(default=1.0, ge=0)  # of the loss on features of the images
    smoothness_weight: float = Field(default=0.0, ge=0)  # on steps of depth, as unsup3d for cars
    curvature_weight: float = Field(default=3.0, ge=0)  # on second differences of depth; 0 in the paper
    raised_weight: float = Field(default=1.0, ge=0)  # on a mean surface that is hollow; 0 in the paper
    lean_weight: float = Field(default=10.0, ge=0)  # on a mean view from above by another angle than lean_deg
    photometric_weight: float = Field(default=1.0, gt=0)  # without confidence 2 is unsup3d's L1 in -1..1
    perceptual_rescaled: bool = True  # VGG16's features by their standard deviation; not in the paper
    vgg16_path: str | None = None  # None: the file torch hub keeps
    self_features_steps: int = Field(default=600, ge=1)  # steps in which features are learned
    loocc: str = "none"  # factors that are perturbed, joined by +; or all
    loocc_joint: bool = False  # Eq. 6: one code of all factors side by side, instead of factor by factor
    loocc_weight: float = Field(default=0.01, ge=0)  # of LOOCC in the total loss
    loocc_temperature: float = Field(default=0.5, gt=0)  # of cosines in LOOCC (NT-Xent)
    cycle_weight: float = Field(default=0.0, ge=0)  # light and camera predicted from LOOCC's renderings
    template_share: float = Field(default=0.0, ge=0, le=1)  # of the run: all share one shape and albedo
    template_albedo: bool = True  # False: only the shape is shared, for objects of many colours
    release_share: float = Field(default=0.0, ge=0, le=1)  # of the run: each gets its own gradually
    perturb: PerturbSettings = PerturbSettings()


class WhiteningSettings(Settings):
    """How activations become features after training (postprocess/whitening.py); 0 images: codes are."""

    pictures: int = Field(default=3_000, ge=0)  # training images that are re-rendered
    views: int = Field(default=4, ge=1)  # renderings of each
    spatial: bool = True  # with the encoder's last spatial map beside the code
    mirrored: bool = True  # with the activations of the mirror image
    directions: int = Field(default=128, ge=1)  # kept of geometry and albedo each, at most the code's size
    shrinkage: float = Field(default=0.1, ge=0)  # share of the mean variance added to every direction's
    photographs: bool = False  # geometry, albedo: views keep the image's own pixels, in light from any side
    canonical: bool = False  # geometry: of the image turned into the canonical view
    framing: int = Field(default=0, ge=0)  # geometry, albedo: crops by which framing is learned; 0: none
    gradients: bool = False  # albedo: with directions and histograms of the image's gradients
    evenness: float = Field(default=0.5, ge=0, le=1)  # 0: the most discriminative directions count most
    vectors: bool = True  # light and camera have features of their own; else those are their codes
    vector_power: float = Field(default=3.0, ge=0)  # of repeatability, by which their directions are weighted


class FeatureSettings(Settings):
    """All settings of `derender whiten`: how features are estimated, and how far scenes are perturbed."""

    whitening: WhiteningSettings = WhiteningSettings()
    fitting: FittingSettings = FittingSettings()
    perturb: PerturbSettings = PerturbSettings()
    brightness: bool = True  # estimate the prior that shares brightness between albedo and light


class LastRefining(Settings):
    """How a run ends: networks learn the scenes that optimisation finds, as by `derender refine`."""

    rounds: int = Field(default=0, ge=0)  # each begins with scenes that are optimised anew
    images: int = Field(default=60_000, ge=1)  # seen in each
    fitted_cameras: bool = True  # as in RefiningSettings


class OptimiserSettings(Settings):
    """Adam with weight decay, after a linear warm-up; ``final_rate`` < 1 lets it fall along a cosine."""

    learning_rate: float = Field(default=1e-4, gt=0)
    final_rate: float = Field(default=1.0, gt=0, le=1)  # share of learning_rate at the end
    weight_decay: float = Field(default=5e-4, ge=0)
    warmup_images: int = Field(default=0, ge=0)  # images over which the rate rises to learning_rate
    betas: tuple[float, float] = (0.9, 0.999)

    def rate(self, images: int, total_images: int) -> float:
        """The learning rate after so many images: linear warm-up from zero, then constant or the cosine."""
        if images < self.warmup_images:
            return self.learning_rate * (images + 1) / self.warmup_images
        span = max(total_images - self.warmup_images, 1)
        done = min((images - self.warmup_images) / span, 1.0)
        share = self.final_rate + (1 - self.final_rate) * (1 + math.cos(math.pi * done)) / 2
        return self.learning_rate * share


class LoopSettings(Settings):
    """Settings of every run of the training loop, whatever it trains."""

    optimiser: OptimiserSettings = OptimiserSettings()
    batch_size: int = Field(default=64, ge=2)
    images: int = Field(default=600_000, ge=1)  # images of the whole run, repeats counted
    minutes: float | None = Field(default=None, gt=0)  # end the run, and its schedules, by then
    validate_every: int = Field(default=20_000, ge=1)  # images between validations
    sample_every: int = Field(default=20_000, ge=1)  # images between sample sheets
    checkpoint_every: int = Field(default=20_000, ge=1)  # images between checkpoints
    patience: int = Field(default=10, ge=1)  # validations without improvement before stopping
    keep: Literal["best", "last"] = "best"  # the model: of the best validation, or of the last checkpoint
    horizontal_flips: bool = True  # show half of the images mirrored
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)  # train, validation, test
    precision: Literal["32-true", "bf16-mixed"] = "32-true"  # networks only; geometry is always float32
    channels_last: bool = True  # memory layout of networks: speed only
    cuda_graph: Literal["auto", "off"] = "auto"  # on a GPU: replay recorded steps where that is faster
    compile: Literal["auto", "off"] = "off"  # auto: torch.compile networks where that makes steps faster
    deterministic: bool = False  # repeat a run bit for bit, slower
    watch: bool = True  # look for collapse and return to the last good checkpoint
    seed: int = 0

    @field_validator("cuda_graph", "compile", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        return "off" if value is False else value  # as YAML reads the word


class TrainConfig(LoopSettings):
    """One training run of a `Derenderer`, whole."""

    preset: str = "faces"
    start_from: str | None = None  # a trained model whose weights the run begins with
    maps_only: bool = False  # train decoders of maps and the confidence net: features stay the start's
    geometry_start: float = Field(default=GEOMETRY_START, gt=0)  # last layer's first weights; 1 in the paper
    accumulate: int = Field(default=1, ge=1)  # chunks of a batch: less memory, same losses, slower
    model: ModelSettings = ModelSettings()
    objective: ObjectiveSettings = ObjectiveSettings()
    whitening: WhiteningSettings = WhiteningSettings()
    fitting: FittingSettings = FittingSettings()
    brightness: bool = True  # as in FeatureSettings
    refining: LastRefining = LastRefining()

    @field_validator("model")
    @classmethod
    def _without_decoder(cls, value: ModelSettings) -> ModelSettings:
        if value.network.unet_decoder:
            raise ValueError("network.unet_decoder: rendering trains none, derender unet distils one")
        return value

    @field_validator("refining")
    @classmethod
    def _refinable(cls, value: LastRefining, given: Any) -> LastRefining:
        fitting = given.data.get("fitting")
        if value.rounds and fitting is not None and (given.data.get("maps_only") or fitting.examples < 2):
            raise ValueError("refining needs maps_only=false and fitting.examples=2 or more")
        return value

    @property
    def features(self) -> FeatureSettings:
        """How features are estimated once training has ended."""
        none = {"pictures": 0} if self.maps_only else {}  # activations are those of the start
        how = {"fitting": self.fitting, "perturb": self.objective.perturb, "brightness": self.brightness}
        return FeatureSettings(whitening=self.whitening.model_copy(update=none), **how)


class TargetSettings(Settings):
    """Labels beside the rendering objective: total = rendering_weight * rendering + weight * labels."""

    labels: tuple[str, ...] = ()  # label columns: one of classes, or any number of two values each
    factors: tuple[str, ...] = ("geometry", "albedo")  # whose codes the head takes
    weight: float = Field(default=1.0, gt=0)  # of the labels' loss
    rendering_weight: float = Field(default=1.0, ge=0)  # 0: nothing is rendered, plain fine-tuning
    labelled: int | None = Field(default=None, ge=2)  # training images whose labels are used; None: all


class FinetuneConfig(TrainConfig):
    """One joint training with labels, whole."""

    start: str | None = None  # the pre-trained run or model; None: from fresh weights
    target: TargetSettings = TargetSettings()
    images: int = Field(default=100_000, ge=1)  # images of the whole run, repeats counted
    validate_every: int = Field(default=5_000, ge=1)
    checkpoint_every: int = Field(default=5_000, ge=1)


REMOVED: dict[str, Any] = {  # of earlier versions: runs with them at this value (...: at any) still load
    "objective.loocc_after": 0.0, "reframe": ..., "reframed": 0.0, "whitening.frames": 0,
    "whitening.reframe": ...,
}  # fmt: skip

_CHANGES = table_beside(__file__, "presets.yaml")
PRESETS: dict[str, TrainConfig] = {
    name: TrainConfig.model_validate({"preset": name, "model": MODEL_PRESETS[name], **changes})
    for name, changes in _CHANGES.items()
}


def resolve(preset: str, overrides: Iterable[str] = (), **explicit: Any) -> TrainConfig:
    """The configuration of a run: a preset, then changes as ``derender.overrides.with_changes`` makes them.

    With ``start_from`` the model has that model's settings (without a U-Net decoder) instead of the preset's,
    before overrides change them. A larger ``image_size`` than its own makes it grow (``maps_only``).

    Raises:
        ValueError: unknown preset, renderer, factor or key (names the nearest), or a value that does not fit.
        FileNotFoundError: there is no model to start from.
    """
    overrides, row = list(overrides), named_preset(preset, PRESETS)
    config = with_changes(row, overrides, **explicit)
    if config.start_from is not None:
        model = load(config.start_from).settings
        network = model.network.model_copy(update={"unet_decoder": False})
        model = model.model_copy(update={"network": network, "brightness": None})
        row = row.model_copy(update={"model": model})
        config = with_changes(row, overrides, **explicit)
        if (size := config.model.network.image_size) > network.image_size:
            row = row.model_copy(update={"model": model.grown(size), "maps_only": True})
            config = with_changes(row, overrides, **explicit)
        if config.model.renderer != model.renderer:
            made = f"it was made with the renderer {model.renderer!r}, not {config.model.renderer!r}"
            raise ValueError(f"cannot start from {config.start_from}: {made}")
    loocc_factors(config.objective.loocc, renderer_named(config.model.renderer).all_factors)
    return config


def to_yaml(config: Settings) -> str:
    """The whole configuration as YAML, in the order of its definition."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def as_overrides(tree: Mapping[str, Any]) -> list[str]:
    """Plain values, nested or with dotted keys, as the ``key=value`` that ``with_changes`` takes."""
    return [f"{key}={json.dumps(value)}" for key, value in settings_by_name(tree).items()]


def without_removed(tree: dict[str, Any]) -> dict[str, Any]:
    """Stored settings without those of ``REMOVED``; a value this version cannot honour is a ValueError."""
    for key, neutral in REMOVED.items():
        *parents, last = key.split(".")
        part = tree.get(parents[0]) if parents else tree
        value = part.pop(last, neutral) if isinstance(part, dict) else neutral
        if value != neutral and neutral is not ...:
            fix = f"it can be {neutral}, not {SHORT.repr(value)}; use an earlier version of derender"
            raise ValueError(f"setting {key!r} no longer exists: {fix}")
    return tree
