"""Knowledge distillation of test-time optimisation: encoders that predict the scenes which it finds.

Fitting (postprocess/fitting.py) brings a scene nearer to its image than the encoders do, but takes many times
as long. Here scenes are fitted to the training images once, and a copy of the model, the student, learns to
predict them: from the images, and from renderings of the fitted scenes under other light, from other
viewpoints and with another's geometry, whose scenes are known exactly. The student's scenes are also asked to
reconstruct the images. Images in other crops (``reframed``) teach the position of the camera, which rendering
alone does not. Needs no labels. A renderer's further factors are learnt like light and camera, further maps
as the model predicts them. Leaves out the confidence net, which stays.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from pydantic import Field
from torch import Generator, Tensor, nn

from derender.data import Progress, as_float
from derender.model import Derenderer
from derender.networks.encoders import Images, Pixels
from derender.networks.factors import Number
from derender.objectives.reconstruction import masked_l1
from derender.objectives.self_features import one_cycle
from derender.postprocess.fitting import NOISE, PARAMETERS, STEPS, MorphableMaps
from derender.scene import Scene, crop
from derender.scene.perturb import PerturbSettings
from derender.scene.scene import seen_in_mirror
from derender.settings import Settings
from derender.training.config import FeatureSettings
from derender.training.features import make_features
from derender.training.step import fill_uncovered, where_rows
from derender.training.views import batches

MEASURED_IMAGES = 256  # images on which standard deviations and errors are measured


class StudentSettings(Settings):
    """How a student learns; ``images`` counts an image as often as it is seen."""

    images: int = Field(default=160_000, ge=1)
    batch_size: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=4e-4, gt=0)

    def learn(
        self, what: str, student: nn.Module, optimiser: torch.optim.Optimizer,
        loss: Callable[[Tensor], Tensor], count: int, generator: Generator, report: Progress, **how: Any,
    ) -> None:  # fmt: skip
        """Minimise a loss of rows of ``count`` images by `one_cycle`; weights of NaN are a ValueError."""
        batch = min(self.batch_size, count)
        steps = math.ceil(self.images / batch)
        for step, _ in one_cycle(optimiser, loss, count, batch, steps, generator, **how):
            report(min(step * batch, self.images), self.images)
        if not all(bool(value.isfinite().all()) for value in student.state_dict().values()):
            ended = f"{what} ended in weights that are NaN or infinite after {self.images:,} images"
            raise ValueError(f"{ended}: give another seed or a lower learning_rate")


class RefiningSettings(StudentSettings):
    """How encoders and decoders learn the fitted scenes."""

    fitted: int = Field(default=12_000, ge=2)  # at most so many images are fitted
    fit_steps: int = Field(default=STEPS, ge=1, le=10_000)  # steps by which each scene is optimised
    worst: float = Field(default=0.03, ge=0, lt=1)  # share of them, fitted worst, that is left out
    rendered: float = Field(default=0.5, ge=0, le=1)  # share of a batch that are renderings
    exchanged: float = Field(default=0.5, ge=0, le=1)  # share of those with another's geometry
    picture_weight: float = Field(default=1.0, ge=0)  # of the reconstruction error
    fitted_cameras: bool = True  # images teach their fitted cameras; False: renderings alone teach cameras
    reframed: float = Field(default=0.0, ge=0, le=1)  # share of a batch that is shown in other crops
    strange: float = Field(default=0.5, ge=0, le=1)  # share of those with another image beyond their edge


class RefineConfig(FeatureSettings):
    """All settings of `derender refine`; ``perturb`` is also how far its renderings differ."""

    refining: RefiningSettings = RefiningSettings()
    perturb: PerturbSettings = PerturbSettings(
        ambient=1, diffuse=1, light_deg=90, camera_pitch_deg=30, camera_yaw_deg=60
    )
    reframe: crop.CropSettings = crop.DEFAULT_CROPS  # of refining.reframed; the camera gets room for them


@dataclass(frozen=True)
class Student:
    """A copy of a model that learned from it, in evaluation mode, and its errors and gaps by name."""

    model: Derenderer
    errors: dict[str, float]
    gaps: dict[str, dict[str, float]] = field(default_factory=dict)


def refine(
    model: Derenderer, images: Pixels, held_out: UInt8[Tensor, "m 3 h w"],
    config: RefineConfig | None = None, *, seed: int = 0, progress: Progress | None = None,
) -> Student:  # fmt: skip
    """A copy of a trained model that predicts what fitting finds; the model stays as it is.

    ``errors`` "before", "now" and "fitted" are the mean masked L1 (0..1) of reconstructions. ``gaps``, by
    parameter of a scene, are how far predictions lie from fitted scenes, "before" and "now", in mean
    deviations.
    The same seed gives the same weights on the same machine and thread count; torch's global random state is
    neither read nor changed. Errors are measured on ``held_out`` images. A ValueError: a model that cannot
    fit scenes; too few images, or of another size; weights that end up not finite.
    """
    config, report = config or RefineConfig(), progress or (lambda *_: None)
    settings = config.refining
    maps = model.features.required_fitting().maps
    if len(images) < 2 or not len(held_out) or images.shape[-1] != model.image_size:
        wanted = f"2 images or more of {model.image_size} pixels and one held out"
        got = f"{len(images)} of {images.shape[-1]} and {len(held_out)}"
        raise ValueError(f"refining needs {wanted}, got {got}")
    generator = Generator().manual_seed(seed)
    rows = torch.randperm(len(images), generator=generator)[: settings.fitted]
    fitted = fit_scenes(model, images[rows], settings.fit_steps, report)
    clear = fitted.clear(settings.worst).cpu()
    if not clear.any():
        raise ValueError("fitting finds no scene of any image: the model's training went wrong")
    student = deepcopy(model.without_features()).with_brightness(None)
    student.source = None
    if settings.reframed:
        ranges = crop.ranges_for_crops(student.settings.ranges, student.image_size, config.reframe)
        student.settings = student.settings.model_copy(update={"ranges": ranges})
    _learn(student, images[rows[clear]], maps, fitted.rows(clear), config, generator, report)
    fitting = config.fitting.model_copy(update={"coordinates": maps.size("depth")})
    features = config.model_copy(update={"fitting": fitting})
    student = make_features(student, images, features, seed=seed, progress=progress, maps=maps)
    return Student(student, *_compared(model, student, held_out[:MEASURED_IMAGES], settings.fit_steps))


@dataclass(frozen=True)
class FittedScenes:
    """Fitted scenes, compact."""

    values: Mapping[str, Tensor]  # parameters of the scene, each with N rows, but coordinates of its maps
    error: Float[Tensor, " n"]  # each image's remaining one

    def rows(self, rows: Tensor | slice) -> "FittedScenes":
        """Some of the scenes."""
        return FittedScenes({name: value[rows] for name, value in self.values.items()}, self.error[rows])

    def clear(self, worst: float) -> Bool[Tensor, " n"]:
        """All but the share with the largest errors, and those that are not finite or out of the image."""
        columns = (*self.values.values(), self.error)
        finite = torch.stack([value.isfinite().reshape(len(value), -1).all(dim=1) for value in columns])
        result = finite.all(dim=0) & (self.error > 0)  # where nothing is rendered there is no error
        return result & (self.error <= self.error.quantile(1 - worst))

    def scene(self, maps: MorphableMaps) -> Scene:
        fitted = {name: maps.maps(name, self.values[name]) for name in PARAMETERS.values()}
        return Scene.from_parameters({**self.values, **fitted, "albedo": fitted["albedo"].clamp(0, 1)})


def fit_scenes(model: Derenderer, images: Pixels, steps: int, report: Progress) -> FittedScenes:
    """Scenes fitted to all images, batch by batch."""
    model = model.with_brightness(None)  # coordinates are of albedos as decoded
    parts: list[dict[str, Tensor]] = []
    for _, batch in batches(model, images, torch.arange(len(images)), report):
        result = model.fit_scenes(batch, steps)
        own = {parameter: result.coordinates[name] for name, parameter in PARAMETERS.items()}
        parts.append({"error": result.after, **result.scene.parameters, **own})
    values = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return FittedScenes(values, values.pop("error"))


def _learn(
    student: Derenderer, images: Pixels, maps: MorphableMaps, fitted: FittedScenes,
    config: RefineConfig, generator: Generator, report: Progress,
) -> None:  # fmt: skip
    """Train the student's networks of all factors in place."""
    settings = config.refining
    learning = nn.ModuleList([student.nets[row.name] for row in student.factors])
    learning.requires_grad_(True).train()
    optimiser = torch.optim.Adam(learning.parameters(), settings.learning_rate)
    few = slice(0, MEASURED_IMAGES)
    seen, scenes = as_float(images[few]).to(student.device), fitted.rows(few).scene(maps)
    unit = SceneUnit(student, _cropped(seen, scenes, student, config, Generator().manual_seed(0))[1])

    def loss(rows: Tensor) -> Tensor:
        shown = as_float(images[rows]).to(student.device)
        shown, target = examples(student, shown, fitted.rows(rows).scene(maps), config, generator)
        predicted = student.decompose(shown)
        photographs = slice(round(len(rows) * settings.rendered), None)  # renderings have exact scenes
        if not settings.fitted_cameras:
            target.camera[photographs] = predicted.camera[photographs].detach()
        total = unit.distance(predicted, target)
        if settings.picture_weight and len(shown[photographs]):
            again = student.render(predicted[photographs])
            error = masked_l1(again.image, shown[photographs], again.mask.detach())
            total = total + settings.picture_weight * error / NOISE
        return total

    settings.learn("refining", student, optimiser, loss, len(images), generator, report, warm_up=0.05)
    student.requires_grad_(False).eval()


@torch.no_grad()
def examples(
    model: Derenderer, images: Images, fitted: Scene, config: RefineConfig, generator: Generator
) -> tuple[Images, Scene]:
    """A batch to learn from, and its scenes: renderings first, then images, half of them mirrored."""
    settings, ranges = config.refining, model.settings.ranges
    rendered = round(len(images) * settings.rendered)
    exchanged = round(rendered * settings.exchanged)
    changed = {"depth": torch.cat([fitted.depth[:exchanged].roll(1, 0), fitted.depth[exchanged:]])}
    for row in model.factors:
        if row.perturb is not None and not row.mirrored:
            value = fitted.parameters[row.parameter]
            changed[row.parameter] = row.perturb(value, generator, config.perturb, ranges)
    otherwise = fitted.with_parameters(**changed)[:rendered]
    shown, scene = images, fitted
    if rendered:
        made = model.render(otherwise)
        filled = fill_uncovered(made.image, made.mask, images[:rendered])
        shown = torch.cat([filled.clamp(0, 1), images[rendered:]])
        scene = Scene.joined([otherwise, fitted[rendered:]])
    even = [row.parameter for row in model.factors if row.numbers]
    known = {*even, "environment"} >= set(scene.extra)
    mirrored = torch.rand(len(shown), generator=generator) < (0.5 if known else 0)
    mirrored[:rendered] = False  # their light and view are any already
    twin = seen_in_mirror(scene, even).parameters if known else scene.parameters
    both = {name: where_rows(mirrored, twin[name], value) for name, value in scene.parameters.items()}
    shown, scene = where_rows(mirrored, shown.flip(-1), shown), Scene.from_parameters(both)
    return _cropped(shown, scene, model, config, generator)


def _cropped(
    images: Images, scene: Scene, model: Derenderer, config: RefineConfig, generator: Generator
) -> tuple[Images, Scene]:
    """Images and their scenes, a share of both in other crops."""
    settings = config.refining
    if not settings.reframed:
        return images, scene
    crops = crop.random_crops(len(images), generator, config.reframe, settings.reframed)
    strange = torch.rand(len(images), generator=generator) < settings.strange
    surroundings = crop.other_surroundings(images, generator)
    other = crop.crop_images(images, crops, surroundings)
    shown = where_rows(strange, other, crop.crop_images(images, crops))
    return shown, crop.crop_scene(scene, crops, model.settings.ranges.fov_deg)


class SceneUnit:
    """The unit of errors: the mean deviation of fitted scenes, of numbers that the model can change."""

    @torch.no_grad()
    def __init__(self, model: Derenderer, fitted: Scene):
        self.able: dict[str, Bool[Tensor, " k"]] = {}
        self.deviation: dict[str, Tensor] = {}
        for factor in model.factors:
            value = fitted.parameters[factor.parameter]
            self.deviation[factor.parameter] = _mean_deviation(value, factor.numbers)
            if not factor.mirrored:
                ends = (torch.full_like(value[:1], end) for end in (-1.0, 1.0))
                least, most = (factor.to_parameter(end, model.settings.ranges) for end in ends)
                self.able[factor.parameter] = (least != most)[0]
        self.slope = _mean_deviation(_slopes(fitted.depth)).mean()

    def gaps(self, predicted: Scene, target: Scene) -> dict[str, Tensor]:
        """By parameter of a scene, mean absolute difference in this unit."""
        gaps = {}
        for name, deviation in self.deviation.items():
            apart = (predicted.parameters[name] - target.parameters[name]).abs()
            if name in self.able:
                gaps[name] = (apart / deviation)[:, self.able[name]].mean()
            else:
                gaps[name] = apart.mean() / deviation.mean()
        return gaps

    def distance(self, predicted: Scene, target: Scene) -> Float[Tensor, ""]:
        """The sum of the gaps, and that of the slopes of depth, which make the shading."""
        slopes = (_slopes(predicted.depth) - _slopes(target.depth)).abs().mean() / self.slope
        return torch.stack([*self.gaps(predicted, target).values(), slopes]).sum()


def _slopes(depth: Float[Tensor, "n h w"]) -> Float[Tensor, "n d"]:
    """Differences of neighbours, across and down."""
    return torch.cat([depth.diff(dim=-1).flatten(1), depth.diff(dim=-2).flatten(1)], dim=1)


def _mean_deviation(value: Float[Tensor, "n ..."], numbers: Sequence[Number] = ()) -> Tensor:
    """At least a hundredth of each number's range: some images show nothing of an effect."""
    least = value.new_tensor([0.01 * (one.high - one.low) for one in numbers] or [1e-5])
    return torch.maximum((value - value.mean(dim=0)).abs().mean(dim=0), least)


@torch.no_grad()
def _compared(
    model: Derenderer, student: Derenderer, images: Pixels, steps: int
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    model, student = model.with_brightness(None), student.with_brightness(None)
    shown = as_float(images).to(model.device)
    fitted = model.fit_scenes(shown, steps).scene
    unit = SceneUnit(model, fitted)
    predicted = {"before": model.decompose(shown), "now": student.decompose(shown)}
    errors = {}
    for name, scene in {**predicted, "fitted": fitted}.items():
        again = model.render(scene)
        errors[name] = float(masked_l1(again.image, shown, again.mask))
    gaps = {name: unit.gaps(scene, fitted) for name, scene in predicted.items()}
    return errors, {key: {name: float(gap[key]) for name, gap in gaps.items()} for key in gaps["now"]}
