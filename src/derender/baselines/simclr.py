"""SimCLR: an encoder that recognises two views of one picture among all others.

Source: Chen et al., *A Simple Framework for Contrastive Learning of Visual Representations* (ICML 2020): a
projection head of two layers that is left out of the feature, NT-Xent at temperature 0.5. The encoder is that
of our geometry net, so only what it learns from differs. Two kinds of views:

- ordinary: crop, flip, colour jitter, grey and blur (augment.py);
- physical: renderings alone; a trained derender model takes each picture apart, and both views show the
  scene in another light and from another side, drawn as LOOCC draws them. What a view varies is then exactly
  what the feature should not depend on: light and camera.

Leaves out LARS and batches of thousands.
"""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Generator, Tensor, nn

from derender.baselines.augment import AugmentSettings, augment
from derender.baselines.autoencoder import AutoencoderSettings
from derender.baselines.model import BaselineModel
from derender.model import Derenderer, load
from derender.networks.encoders import Encoder
from derender.objectives.loocc import nt_xent
from derender.scene.perturb import PerturbSettings, perturb_camera, perturb_light
from derender.settings import Settings
from derender.training.config import LoopSettings, OptimiserSettings
from derender.training.step import Precision, fill_uncovered

Views = Callable[[Float[Tensor, "n 3 h w"], Generator], Float[Tensor, "n 3 h w"]]


class SimclrSettings(AutoencoderSettings):
    """Sizes of the encoder, as the geometry net's, and of the projection head."""

    projection: int = Field(default=128, ge=1)


class SimclrObjective(Settings):
    """Which views, and how sharply they are told apart."""

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

    name = "simclr"
    features = ("features", "projection")
    settings: SimclrSettings

    def __init__(self, settings: SimclrSettings):
        super().__init__(settings)
        network = settings.network
        self.encoder = Encoder(network, network.width, network.code_size, normalised=True)
        self.head = nn.Sequential(
            nn.Linear(network.code_size, network.code_size),
            nn.ReLU(),
            nn.Linear(network.code_size, settings.projection),
        )

    def describe(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        code = self.encoder(images)
        made = {"features": code}
        if "projection" in self.chosen:
            made["projection"] = self.head(code)
        return {name: made[name] for name in self.chosen}


def simclr_losses(
    model: Simclr,
    images: Float[Tensor, "n 3 h w"],
    objective: SimclrObjective,
    views: Views,
    generator: Generator,
    precision: Precision,
) -> dict[str, Tensor]:
    """NT-Xent of two views; beside it ``found``: the share of views whose nearest other view is its twin."""
    with torch.no_grad():
        seen = torch.cat([views(images, generator), views(images, generator)])
    with precision():
        first, second = model.head(model.encoder(seen)).float().chunk(2)
    return {
        "nt_xent": nt_xent(first, second, objective.temperature),
        "found": twin_found(first.detach(), second.detach()),
    }


def twin_found(first: Float[Tensor, "n d"], second: Float[Tensor, "n d"]) -> Float[Tensor, ""]:
    """Share of the 2N views whose most similar other view is the other one of the same picture, 0 to 1."""
    codes = nn.functional.normalize(torch.cat([first, second]), dim=1)
    similarity = (codes @ codes.T).fill_diagonal_(float("-inf"))
    twin = (torch.arange(len(codes), device=codes.device) + len(first)) % len(codes)
    return (similarity.argmax(dim=1) == twin).float().mean()


def make_views(objective: SimclrObjective, image_size: int, device: torch.device) -> Views:
    """The function that gives one random view of every picture.

    Raises:
        FileNotFoundError: the model for physical views is not there.
        ValueError: it takes pictures of another size.
    """
    if objective.views == "ordinary":
        return lambda images, generator: augment(images, objective.augment, generator)
    assert objective.physics is not None
    renderer = load(objective.physics, device=device)
    if renderer.image_size != image_size:
        raise ValueError(
            f"{objective.physics} takes pictures of {renderer.image_size} pixels, this run of {image_size}: "
            f"set image_size={renderer.image_size}"
        )
    return lambda images, generator: physical_view(renderer, images, objective.perturb, generator)


@torch.no_grad()
def physical_view(
    model: Derenderer, images: Float[Tensor, "n 3 h w"], changes: PerturbSettings, generator: Generator
) -> Float[Tensor, "n 3 h w"]:
    """Every picture taken apart and rendered in another light and from another side, in 0..1."""
    scene, ranges = model.decompose(images), model.settings.ranges
    scene = scene.with_parameters(
        light=perturb_light(scene.light, generator, changes, ranges),
        camera=perturb_camera(scene.camera, generator, changes, ranges),
    )
    rendering = model.render(scene)
    return fill_uncovered(rendering.image, rendering.mask, images).clamp(0, 1)
