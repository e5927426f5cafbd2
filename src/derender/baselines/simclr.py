"""SimCLR: an encoder that recognises two views of one image among all others; and the augmentations.

Source: Chen et al., *A Simple Framework for Contrastive Learning of Visual Representations* (ICML 2020): a
projection head of two layers that is left out of the feature, NT-Xent at temperature 0.5. The encoder is that
of our geometry net, so only its training signal differs. Ordinary views: crop, flip, colour jitter, grey and
blur, each random for every image, with half the source's strengths for colours and larger crops. Physical
views: a trained derender model decomposes each image, and both views show the scene under other lighting and
from another viewpoint, as in LOOCC. Leaves out LARS, batches of thousands, and hue in HSV: colours rotate
about the grey axis of RGB.
"""

import math
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Generator, Tensor, nn
from torch.nn.functional import affine_grid, conv2d, grid_sample, normalize, pad

from derender.baselines.autoencoders import AutoencoderSettings
from derender.baselines.controls import LUMINANCE
from derender.baselines.model import Features, Images, LoopModel, LossInputs
from derender.model import Derenderer, load
from derender.objectives.loocc import nt_xent
from derender.scene.perturb import PerturbSettings
from derender.settings import Settings
from derender.training.batches import random_stream
from derender.training.config import LoopSettings, OptimiserSettings
from derender.training.views import renderings

Views = Callable[[Images, Generator], Images]


class AugmentSettings(Settings):
    """Strengths and probabilities; 0 switches one off (``crop_from`` 1 and ``aspect`` 1 do so with crops)."""

    crop_from: float = Field(default=0.3, gt=0, le=1)  # smallest share of the area that a crop keeps
    aspect: float = Field(default=4 / 3, ge=1)  # largest width over height of a crop, and its inverse
    flip: float = Field(default=0.5, ge=0, le=1)
    jitter: float = Field(default=0.8, ge=0, le=1)
    brightness: float = Field(default=0.4, ge=0, lt=1)
    contrast: float = Field(default=0.4, ge=0, lt=1)
    saturation: float = Field(default=0.4, ge=0, lt=1)
    hue_deg: float = Field(default=36.0, ge=0, le=180)
    grey: float = Field(default=0.2, ge=0, le=1)
    blur: float = Field(default=0.5, ge=0, le=1)
    blur_px: tuple[float, float] = (0.1, 1.0)  # standard deviation, smallest and largest


def augment(images: Images, settings: AugmentSettings, generator: Generator) -> Images:
    """A random view of every image, in 0..1; the same generator gives the same views."""

    def where(probability: float, changed: Tensor) -> Tensor:
        chosen = torch.rand(len(images), generator=generator) < probability
        return torch.where(chosen.to(images.device)[:, None, None, None], changed, images)

    images = crop(images, settings, generator)
    images = where(settings.flip, images.flip(-1))
    images = where(settings.jitter, jitter(images, settings, generator))
    images = where(settings.grey, grey(images))
    return where(settings.blur, blur(images, settings.blur_px, generator))


def crop(images: Images, settings: AugmentSettings, generator: Generator) -> Images:
    """A part of every image, inside it, stretched to the full size (bilinear)."""
    count, widest = len(images), math.log(settings.aspect)
    area = _uniform((count,), settings.crop_from, 1.0, generator)
    stretch = _uniform((count,), -widest, widest, generator).exp()
    sides = torch.stack([(area * stretch).sqrt(), (area / stretch).sqrt()], dim=1).clamp(max=1.0)
    centre = _uniform((count, 2), -1.0, 1.0, generator) * (1 - sides)  # -1..1 spans the image
    change = torch.cat([torch.diag_embed(sides), centre[:, :, None]], dim=2).to(images)
    grid = affine_grid(change, list(images.shape), align_corners=False)
    return grid_sample(images, grid, padding_mode="border", align_corners=False)


def jitter(images: Images, settings: AugmentSettings, generator: Generator) -> Images:
    """Brightness, contrast about the image's mean grey, saturation about each pixel's grey, hue."""
    shape, hue = (len(images), 1, 1, 1), math.radians(settings.hue_deg)

    def away_from(centre: Tensor | float, strength: float) -> Tensor:
        gain = _uniform(shape, 1 - strength, 1 + strength, generator).to(images)
        return (centre + (images - centre) * gain).clamp(0, 1)

    images = away_from(0.0, settings.brightness)
    images = away_from(grey(images).mean(dim=(1, 2, 3), keepdim=True), settings.contrast)
    images = away_from(grey(images), settings.saturation)
    return rotate_hue(images, _uniform((len(images),), -hue, hue, generator).to(images)).clamp(0, 1)


def rotate_hue(images: Images, angle_rad: Float[Tensor, " n"]) -> Images:
    """Colours rotated about the grey axis of RGB; greys stay."""
    cosine, sine = angle_rad.cos(), angle_rad.sin()
    grey, third = (1 - cosine) / 3, sine / math.sqrt(3)
    same, ahead, behind = cosine + grey, grey - third, grey + third
    rows = torch.stack([same, ahead, behind, behind, same, ahead, ahead, behind, same], dim=1)
    return torch.einsum("nij,njhw->nihw", rows.view(-1, 3, 3), images)


def grey(images: Images) -> Images:
    """Luminance in all three channels (ITU-R BT.601)."""
    weights = torch.tensor(LUMINANCE, device=images.device, dtype=images.dtype).view(1, 3, 1, 1)
    return (images * weights).sum(dim=1, keepdim=True).expand_as(images)


def blur(images: Images, sigma_px: tuple[float, float], generator: Generator) -> Images:
    """Gaussian blur with a standard deviation drawn for every image; borders are mirrored."""
    count, channels, height, width = images.shape
    sigma = _uniform((count, 1), *sigma_px, generator).to(images)
    reach = min(math.ceil(3 * sigma_px[1]), height - 1, width - 1)
    steps = torch.arange(-reach, reach + 1, device=images.device)
    kernel = (-0.5 * (steps / sigma).square()).exp()
    kernel = (kernel / kernel.sum(dim=1, keepdim=True)).repeat_interleave(channels, dim=0)
    flat = images.reshape(1, count * channels, height, width)
    flat = conv2d(pad(flat, (reach, reach, 0, 0), "reflect"), kernel[:, None, None, :], groups=len(kernel))
    flat = conv2d(pad(flat, (0, 0, reach, reach), "reflect"), kernel[:, None, :, None], groups=len(kernel))
    return flat.reshape(images.shape)


def _uniform(shape: tuple[int, ...], low: float, high: float, generator: Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)


class SimclrSettings(AutoencoderSettings):
    """Sizes of the encoder, as the geometry net's, and of the projection head."""

    projection: int = Field(default=128, ge=1)


class SimclrObjective(Settings):
    """Which views, and the temperature of their contrast."""

    views: Literal["ordinary", "physical"] = "ordinary"
    physics: str | None = None  # run folder, saved model or Hub id that renders the physical views
    temperature: float = Field(default=0.5, gt=0)
    augment: AugmentSettings = AugmentSettings()
    perturb: PerturbSettings = PerturbSettings()

    @model_validator(mode="after")
    def _physical_views_need_a_model(self) -> "SimclrObjective":
        if (self.views == "physical") != (self.physics is not None):
            raise ValueError("views=physical and physics=RUN (a trained derender model) go together")
        return self


class SimclrConfig(LoopSettings):
    """One training run of SimCLR."""

    baseline: Literal["simclr"] = "simclr"
    model: SimclrSettings = SimclrSettings()
    objective: SimclrObjective = SimclrObjective()
    batch_size: int = Field(default=256, ge=2)
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=1e-3, weight_decay=1e-6)


class Simclr(LoopModel):
    """Encoder and projection head. Features: ``features`` (the encoder's code) and ``projection``."""

    name, settings_type, config_type = "simclr", SimclrSettings, SimclrConfig
    features = ("features", "projection")
    settings: SimclrSettings
    run: SimclrConfig  # in which it learns

    def __init__(self, settings: SimclrSettings):
        super().__init__(settings)
        width = settings.code_size
        self.encoder = settings.encoder()
        self.head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, settings.projection))

    @classmethod
    def build(cls, config: SimclrConfig) -> "Simclr":
        views_of(config, torch.device("cpu"))  # a model that is missing is an error before there is a folder
        model = cls(config.model)
        model.run = config
        return model

    @staticmethod
    def prepare(config: SimclrConfig, device: torch.device, perceptual: Callable) -> Views:
        return views_of(config, device)

    def describe(self, images: Images) -> Features:
        code = self.encoder(images)
        return {"features": code, "projection": self.head(code)}

    def shown(self, images: Images) -> dict[str, Images]:
        views, generator = views_of(self.run, images.device), random_stream(self.run.seed, "perturb", 0)
        return {"input": images, **{f"view {n}": views(images, generator) for n in (1, 2, 3, 4)}}

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """NT-Xent of two views; beside it ``found``: the share of views whose nearest is their twin."""
        with torch.no_grad():
            seen = torch.cat([run.aid(images, run.generator), run.aid(images, run.generator)])
        with run.precision():
            first, second = self.head(self.encoder(seen)).float().chunk(2)
        codes = normalize(torch.cat([first, second]).detach(), dim=1)
        nearest = (codes @ codes.T).fill_diagonal_(float("-inf")).argmax(dim=1)
        twin = torch.arange(len(codes), device=codes.device).roll(len(first))
        loss = nt_xent(first, second, run.config.objective.temperature)
        return {"nt_xent": loss, "found": (nearest == twin).float().mean()}


def views_of(config: SimclrConfig, device: torch.device) -> Views:
    """The function that gives one random view of every image; a model of another size is an error."""
    objective = config.objective
    if objective.physics is None:
        return lambda images, generator: augment(images, objective.augment, generator)
    renderer = load(objective.physics, device=device)
    if (size := renderer.image_size) != config.model.image_size:
        other = f"this run of {config.model.image_size}: set image_size={size}"
        raise ValueError(f"{objective.physics} takes images of {size} pixels, {other}")
    return lambda images, generator: physical_view(renderer, images, objective.perturb, generator)


@torch.no_grad()
def physical_view(
    model: Derenderer, images: Images, changes: PerturbSettings, generator: Generator
) -> Images:
    """Every image decomposed and re-rendered under other lighting and from another viewpoint, in 0..1."""
    seen_in = [factor for factor in model.factors if factor.parameter in ("light", "camera")]
    _, view = renderings(model, model.decompose(images), images, seen_in, changes, generator, 1)
    return view.clamp(0, 1)
