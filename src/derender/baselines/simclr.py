"""SimCLR: an encoder that recognises two views of one image among all others.

Source: Chen et al., *A Simple Framework for Contrastive Learning of Visual Representations* (ICML 2020): a
projection head of two layers that is left out of the feature, NT-Xent at temperature 0.5. The encoder is that
of our geometry net, so only its training signal differs. Two kinds of views:

- ordinary: crop, flip, colour jitter, grey and blur (augment.py);
- physical: renderings alone; a trained derender model decomposes each image, and both views show the scene
  under other lighting and from another viewpoint, sampled as in LOOCC. What differs between views is then
  exactly what the feature should not depend on.

Leaves out LARS and batches of thousands.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float, UInt8
from pydantic import Field, model_validator
from torch import Generator, Tensor, nn

from derender.baselines.augment import AugmentSettings, augment
from derender.baselines.autoencoder import AutoencoderSettings
from derender.baselines.model import BaselineModel, Images, LossInputs
from derender.model import Derenderer, load
from derender.objectives.loocc import nt_xent
from derender.scene.perturb import PerturbSettings, perturb_camera, perturb_light
from derender.settings import Settings
from derender.training.batches import random_stream
from derender.training.config import LoopSettings, OptimiserSettings
from derender.training.step import fill_uncovered

Views = Callable[[Images, Generator], Images]


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


class Simclr(BaselineModel):
    """Encoder and projection head. Features: ``features`` (the encoder's code) and ``projection``."""

    name, settings_type, config_type = "simclr", SimclrSettings, SimclrConfig
    features = ("features", "projection")
    settings: SimclrSettings

    def __init__(self, settings: SimclrSettings):
        super().__init__(settings)
        width = settings.code_size
        self.encoder = settings.encoder()
        self.head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, settings.projection))

    @classmethod
    def build(cls, config: SimclrConfig) -> "Simclr":
        model = cls(config.model)
        views_of(config, torch.device("cpu"))
        return model

    @staticmethod
    def prepare(
        config: SimclrConfig,
        images: UInt8[Tensor, "n 3 h w"],
        file: Path,
        progress: Callable[[int, int], None],
    ) -> Views:
        return views_of(config, images.device)

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        code = self.encoder(images)
        return {"features": code, "projection": self.head(code)}

    def shown(self, images: Images, config: Any) -> dict[str, Images]:
        views, generator = views_of(config, images.device), random_stream(config.seed, "perturb", 0)
        return {"input": images, **{f"view {n}": views(images, generator) for n in (1, 2, 3, 4)}}

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """NT-Xent of two views; beside it ``found``: the share of views whose nearest is their twin."""
        with torch.no_grad():
            seen = torch.cat([run.aid(images, run.generator), run.aid(images, run.generator)])
        with run.precision():
            first, second = self.head(self.encoder(seen)).float().chunk(2)
        return {
            "nt_xent": nt_xent(first, second, run.config.objective.temperature),
            "found": twin_found(first.detach(), second.detach()),
        }


def twin_found(first: Float[Tensor, "n d"], second: Float[Tensor, "n d"]) -> Float[Tensor, ""]:
    """Share of the 2N views whose most similar other view is the other one of the same image, 0 to 1."""
    codes = nn.functional.normalize(torch.cat([first, second]), dim=1)
    similarity = (codes @ codes.T).fill_diagonal_(float("-inf"))
    twin = (torch.arange(len(codes), device=codes.device) + len(first)) % len(codes)
    return (similarity.argmax(dim=1) == twin).float().mean()


def views_of(config: SimclrConfig, device: torch.device) -> Views:
    """The function that gives one random view of every image.

    Raises:
        FileNotFoundError: there is no such model for physical views.
        ValueError: it takes images of another size.
    """
    objective, size = config.objective, config.model.image_size
    if objective.physics is None:
        return lambda images, generator: augment(images, objective.augment, generator)
    renderer = load(objective.physics, device=device)
    if renderer.image_size != size:
        raise ValueError(
            f"{objective.physics} takes images of {renderer.image_size} pixels, this run of {size}: "
            f"set image_size={renderer.image_size}"
        )
    return lambda images, generator: physical_view(renderer, images, objective.perturb, generator)


@torch.no_grad()
def physical_view(
    model: Derenderer, images: Images, changes: PerturbSettings, generator: Generator
) -> Images:
    """Every image decomposed and re-rendered under other lighting and from another viewpoint, in 0..1."""
    scene, ranges = model.decompose(images), model.settings.ranges
    scene = scene.with_parameters(
        light=perturb_light(scene.light, generator, changes, ranges),
        camera=perturb_camera(scene.camera, generator, changes, ranges),
    )
    rendering = model.render(scene)
    return fill_uncovered(rendering.image, rendering.mask, images).clamp(0, 1)
