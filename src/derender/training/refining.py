"""Encoders that learn to say at once what fitting finds; ours.

Fitting (postprocess/fitting.py) brings a scene nearer to its picture than encoders do, but takes many times
as long. Here scenes are fitted to the training pictures once, and a copy of the model learns to read them:
from the pictures, and from renderings of the fitted scenes in other light, from other sides and with
another's geometry, whose scenes are known exactly. So what optimisation finds is amortised; that the scenes
read from pictures render them again is asked for, too. Shown in other frames (``reframed``), pictures teach
where their camera stands, which rendering alone does not: a decoder draws a small thing sooner than a camera
learns to step back. Needs no labels. Leaves out models with further factors, and the confidence net, which
stays.
"""

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from pydantic import Field
from torch import Generator, Tensor, nn

from derender.data import as_float
from derender.model import Derenderer
from derender.objectives.reconstruction import masked_l1
from derender.objectives.self_training import endless_order
from derender.postprocess.fitting import PARAMETERS, STEPS
from derender.postprocess.morphable import MorphableMaps
from derender.scene import Scene
from derender.scene.crop import (
    DEFAULT_CROPS,
    CropSettings,
    crop_images,
    crop_scene,
    other_surroundings,
    random_crops,
    ranges_for_crops,
)
from derender.scene.mirror import seen_in_mirror
from derender.scene.perturb import PerturbSettings, perturb_camera, perturb_light
from derender.settings import Settings
from derender.training.config import FeatureSettings
from derender.training.features import make_features
from derender.training.step import concatenate, fill_uncovered

FACTORS = {**PARAMETERS, "light": "light", "camera": "camera"}
"""Factors that are taught, and what they fill."""

_FIT_BATCH = 128
_NOISE = 0.03  # mean absolute error of a rendering that counts as much as a gap of 1
_MEASURED = 256  # pictures on which spreads are measured, and errors


class RefiningSettings(Settings):
    """How the encoders and decoders learn; ``images`` counts a picture as often as it is seen."""

    images: int = Field(default=160_000, ge=1)
    batch_size: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=4e-4, gt=0)
    fitted: int = Field(default=12_000, ge=2)  # at most so many pictures are fitted
    fit_steps: int = Field(default=STEPS, ge=1, le=10_000)
    worst: float = Field(default=0.03, ge=0, lt=1)  # share of them, fitted worst, that teaches nothing
    rendered: float = Field(default=0.5, ge=0, le=1)  # share of a batch that are renderings
    exchanged: float = Field(default=0.5, ge=0, le=1)  # share of those with another's geometry
    picture_weight: float = Field(default=1.0, ge=0)  # of the error of pictures rendered again
    reframed: float = Field(default=0.0, ge=0, le=1)  # share of a batch that is shown in other frames
    strange: float = Field(default=0.5, ge=0, le=1)  # share of those beyond whose edge lies another picture


class RefineConfig(FeatureSettings):
    """All that `derender refine` can be told; ``perturb`` is how far its renderings differ, too.

    ``reframe`` are the frames of the ``refining.reframed``; the copy's camera gets the room that they need.
    """

    refining: RefiningSettings = RefiningSettings()
    perturb: PerturbSettings = PerturbSettings(
        ambient=1, diffuse=1, light_deg=90, camera_pitch_deg=30, camera_yaw_deg=60
    )
    reframe: CropSettings = DEFAULT_CROPS


@dataclass(frozen=True)
class Refined:
    """A model that was taught by its own fitted scenes, and what that brought.

    Attributes:
        model: the copy, in evaluation mode, with features.
        errors: of pictures that taught nothing: "before", "now" and "fitted" are the mean masked L1 (0..1) of
            their renderings.
        gaps: by what fills a scene (depth, albedo, light, camera), how far what is read lies from what
            fitting finds, "before" and "now", in parts of how far fitted scenes lie from their mean.
    """

    model: Derenderer
    errors: dict[str, float]
    gaps: dict[str, dict[str, float]]


Progress = Callable[[int, int], object]


def refine(
    model: Derenderer,
    images: UInt8[Tensor, "n 3 h w"],
    held_out: UInt8[Tensor, "m 3 h w"],
    config: RefineConfig | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> Refined:
    """A copy of a trained model that reads what fitting finds; the model stays as it is.

    The same seed gives the same weights on the same machine and thread count; torch's global random state is
    neither read nor changed. The copy fits scenes within the linear model that the model has.

    Args:
        model: trained, with what fits scenes.
        images: what it was trained on, or more of the kind.
        held_out: pictures that teach nothing, on which errors are measured.
        config: how, and how features are made afterwards.
        seed: of every draw.
        progress: called with (pictures done, pictures in all), once for each part of the work.

    Raises:
        ValueError: a model that cannot fit scenes or has further factors; too few pictures, or pictures of
            another size; weights that are NaN or infinite in the end.
    """
    config = config or RefineConfig()
    settings = config.refining
    maps = _maps_of(model)
    if len(images) < 2 or not len(held_out) or images.shape[-1] != model.image_size:
        raise ValueError(
            f"refining needs 2 pictures or more of {model.image_size} pixels and one held out, got "
            f"{len(images)} of {images.shape[-1]} and {len(held_out)}"
        )
    generator = Generator().manual_seed(seed)
    rows = torch.randperm(len(images), generator=generator)[: settings.fitted]
    fitted = _fit(model, images[rows], settings.fit_steps, progress)
    clear = fitted.clear(settings.worst).cpu()
    if not clear.any():
        raise ValueError("fitting finds no scene of any picture: the model's training went wrong")
    student = deepcopy(model.without_features())
    student.source = None
    if settings.reframed:
        _give_room(student, config.reframe)
    _learn(student, images[rows[clear]], maps, fitted[clear], config, generator, progress)
    if not all(bool(value.isfinite().all()) for value in student.state_dict().values()):
        raise ValueError(
            f"refining ended in weights that are NaN or infinite after {settings.images:,} pictures: "
            "give another seed or a lower learning_rate"
        )
    as_many = config.fitting.model_copy(update={"coordinates": maps.size("depth")})
    features = config.model_copy(update={"fitting": as_many})
    student = make_features(student, images, features, seed=seed, progress=progress, maps=maps)
    return Refined(student, *_compared(model, student, maps, held_out[:_MEASURED], settings.fit_steps))


@dataclass(frozen=True)
class _Fits:
    """Fitted scenes, short: coordinates instead of maps; ``error`` is each picture's that is left."""

    geometry: Float[Tensor, "n k"]
    albedo: Float[Tensor, "n k"]
    light: Float[Tensor, "n 4"]
    camera: Float[Tensor, "n 6"]
    error: Float[Tensor, " n"]

    def __getitem__(self, rows: Tensor | slice) -> "_Fits":
        return _Fits(*(value[rows] for value in vars(self).values()))

    def clear(self, worst: float) -> Bool[Tensor, " n"]:
        """All but the share with the largest errors, and those that are no numbers or out of the picture."""
        finite = torch.stack(
            [value.isfinite().reshape(len(value), -1).all(dim=1) for value in vars(self).values()]
        )
        found = finite.all(dim=0) & (self.error > 0)  # where nothing is seen there is no error
        return found & (self.error <= self.error.quantile(1 - worst))

    def scene(self, maps: MorphableMaps) -> Scene:
        depth, albedo = maps.maps("depth", self.geometry), maps.maps("albedo", self.albedo)
        return Scene(depth, albedo.clamp(0, 1), self.light, self.camera)


def _maps_of(model: Derenderer) -> MorphableMaps:
    further = [factor.name for factor in model.factors if factor.name not in FACTORS]
    if further:
        raise ValueError(f"the model has {further[0]} beside the paper's factors: it cannot be refined")
    return model.features.required_fitting().maps


def _fit(model: Derenderer, images: UInt8[Tensor, "n 3 h w"], steps: int, progress: Progress | None) -> _Fits:
    parts = []
    for start in range(0, len(images), _FIT_BATCH):
        found = model.fit_scenes(as_float(images[start : start + _FIT_BATCH]).to(model.device), steps)
        own = found.coordinates
        parts.append((own["geometry"], own["albedo"], found.scene.light, found.scene.camera, found.after))
        if progress is not None:
            progress(min(start + _FIT_BATCH, len(images)), len(images))
    return _Fits(*(torch.cat(part) for part in zip(*parts, strict=True)))


def _give_room(student: Derenderer, reframe: CropSettings) -> None:
    """Widen the ranges of its camera's position so that scenes in such crops can be said."""
    ranges = ranges_for_crops(student.settings.ranges, student.image_size, reframe)
    student.settings = student.settings.model_copy(update={"ranges": ranges})


def _learn(
    student: Derenderer,
    images: UInt8[Tensor, "n 3 h w"],
    maps: MorphableMaps,
    fitted: _Fits,
    config: RefineConfig,
    generator: Generator,
    progress: Progress | None,
) -> None:
    """Train the student's networks of the four factors in place."""
    settings = config.refining
    learning = nn.ModuleList([student.nets[name] for name in FACTORS])
    learning.requires_grad_(True).train()
    optimiser = torch.optim.Adam(learning.parameters(), settings.learning_rate)
    batch = min(settings.batch_size, len(images))
    steps = math.ceil(settings.images / batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=steps + 1, pct_start=0.05, cycle_momentum=False
    )
    seen, scenes = as_float(images[:_MEASURED]).to(student.device), fitted[:_MEASURED].scene(maps)
    unit = _Unit(student, _reframed(seen, scenes, student, config, Generator().manual_seed(0))[1])
    order = endless_order(len(images), generator)
    for step in range(steps):
        rows = torch.tensor([next(order) for _ in range(batch)])
        pictures, meant = as_float(images[rows]).to(student.device), fitted[rows].scene(maps)
        shown, meant = _lesson(student, pictures, meant, config, generator)
        found = student.decompose(shown)
        loss = unit.apart(found, meant)
        pictured = slice(round(batch * settings.rendered), None)  # renderings: their scenes say it all
        if settings.picture_weight and len(shown[pictured]):
            again = student.render(found[pictured])
            error = masked_l1(again.image, shown[pictured], again.mask.detach())
            loss = loss + settings.picture_weight * error / _NOISE
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
        if progress is not None:
            progress(min((step + 1) * batch, settings.images), settings.images)
    student.requires_grad_(False).eval()


@torch.no_grad()
def _lesson(
    model: Derenderer,
    pictures: Float[Tensor, "n 3 h w"],
    meant: Scene,
    config: RefineConfig,
    generator: Generator,
) -> tuple[Float[Tensor, "n 3 h w"], Scene]:
    """A batch to learn from, and its scenes: renderings first, then pictures, half of them mirrored."""
    settings, ranges = config.refining, model.settings.ranges
    rendered = round(len(pictures) * settings.rendered)
    exchanged = round(rendered * settings.exchanged)
    depth = meant.depth.clone()
    depth[:exchanged] = depth[:exchanged].roll(1, 0)
    otherwise = meant.with_parameters(
        depth=depth,
        light=perturb_light(meant.light, generator, config.perturb, ranges),
        camera=perturb_camera(meant.camera, generator, config.perturb, ranges),
    )[:rendered]
    parts = [(pictures[rendered:], meant[rendered:])]
    if rendered:
        made = model.render(otherwise)
        filled = fill_uncovered(made.image, made.mask, pictures[:rendered])
        parts.insert(0, (filled.clamp(0, 1), otherwise))
    shown, scene = torch.cat([one for one, _ in parts]), concatenate([one for _, one in parts])
    mirrored = torch.rand(len(shown), generator=generator) < 0.5
    mirrored[:rendered] = False  # their light and view are any already
    twin = seen_in_mirror(scene)
    shown = _either(mirrored, shown.flip(-1), shown)
    scene = scene.with_parameters(
        **{name: _either(mirrored, twin.parameters[name], value) for name, value in scene.parameters.items()}
    )
    return _reframed(shown, scene, model, config, generator)


def _reframed(
    pictures: Float[Tensor, "n 3 h w"],
    scene: Scene,
    model: Derenderer,
    config: RefineConfig,
    generator: Generator,
) -> tuple[Float[Tensor, "n 3 h w"], Scene]:
    """Pictures and their scenes, a share of both in other frames."""
    settings = config.refining
    if not settings.reframed:
        return pictures, scene
    frames = random_crops(len(pictures), generator, config.reframe, settings.reframed)
    strange = torch.rand(len(pictures), generator=generator) < settings.strange
    around = other_surroundings(pictures, generator)
    shown = _either(strange, crop_images(pictures, frames, around), crop_images(pictures, frames))
    return shown, crop_scene(scene, frames, model.settings.ranges.fov_deg)


def _either(rows: Tensor, one: Tensor, other: Tensor) -> Tensor:
    return torch.where(rows.to(one.device).view(-1, *[1] * (one.ndim - 1)), one, other)


class _Unit:
    """What errors are measured in: how far fitted scenes lie from their mean.

    Numbers that the model cannot change (a translation whose range is 0) do not count.
    """

    def __init__(self, model: Derenderer, fitted: Scene):
        with torch.no_grad():
            self.able = {name: _able(model, name, fitted.parameters[name]) for name in ("light", "camera")}
            self.spread = {name: _mean_deviation(value) for name, value in fitted.parameters.items()}
            self.slope = _mean_deviation(_slopes(fitted.depth)).mean()

    def gaps(self, found: Scene, meant: Scene) -> dict[str, Tensor]:
        """By what fills a scene, mean absolute difference in this unit."""
        apart = {name: (value - meant.parameters[name]).abs() for name, value in found.parameters.items()}
        gaps = {name: apart[name].mean() / self.spread[name].mean() for name in PARAMETERS.values()}
        for name, able in self.able.items():
            gaps[name] = (apart[name] / self.spread[name])[:, able].mean()
        return gaps

    def apart(self, found: Scene, meant: Scene) -> Float[Tensor, ""]:
        """The sum of the gaps, and that of the slopes of depth, which make the shading."""
        slopes = (_slopes(found.depth) - _slopes(meant.depth)).abs().mean() / self.slope
        return torch.stack([*self.gaps(found, meant).values(), slopes]).sum()


def _able(model: Derenderer, name: str, values: Float[Tensor, "n k"]) -> Bool[Tensor, " k"]:
    """Which numbers of a factor the model's ranges let it change."""
    (factor,) = (factor for factor in model.factors if factor.name == name)
    least, most = (
        factor.to_parameter(torch.full_like(values[:1], end), model.settings.ranges) for end in (-1.0, 1.0)
    )
    return (least != most)[0]


def _slopes(depth: Float[Tensor, "n h w"]) -> Float[Tensor, "n d"]:
    """Differences of neighbours, across and down."""
    return torch.cat([depth.diff(dim=-1).flatten(1), depth.diff(dim=-2).flatten(1)], dim=1)


def _mean_deviation(value: Float[Tensor, "n ..."]) -> Tensor:
    return (value - value.mean(dim=0)).abs().mean(dim=0).clamp(min=1e-5)


@torch.no_grad()
def _compared(
    model: Derenderer, student: Derenderer, maps: MorphableMaps, images: UInt8[Tensor, "n 3 h w"], steps: int
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Errors and gaps of ``Refined``."""
    pictures = as_float(images).to(model.device)
    meant = model.fit_scenes(pictures, steps).scene
    unit = _Unit(model, meant)
    read = {"before": model.decompose(pictures), "now": student.decompose(pictures)}
    errors = {}
    for name, scene in {**read, "fitted": meant}.items():
        again = model.render(scene)
        errors[name] = float(masked_l1(again.image, pictures, again.mask))
    found = {name: unit.gaps(scene, meant) for name, scene in read.items()}
    gaps = {key: {name: float(of[key]) for name, of in found.items()} for key in found["now"]}
    return errors, gaps
