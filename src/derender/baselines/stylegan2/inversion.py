"""How an e4e encoder learns to invert a generator that stays as it is.

Source: Tov et al. (SIGGRAPH 2021): squared error and perceptual distance between picture and inversion; codes
are released one after the other, and what they add to the first is kept small, so that W+ stays near W. The
perceptual features are our own, learnt without labels from the same pictures. Instead of e4e's discriminator
of codes the first code is drawn towards the mean code. Leaves out the identity loss, which needs a face
recogniser.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Generator as RandomGenerator
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, mse_loss

from derender.baselines.model import saved_baseline
from derender.baselines.stylegan2.adversarial import CENTRE_LATENTS, Stylegan
from derender.baselines.stylegan2.e4e import E4e, E4eSettings, EncoderSettings
from derender.baselines.stylegan2.generator import Generator, GeneratorSettings
from derender.baselines.stylegan2.published import load_published_generator
from derender.objectives.frozen import PerceptualFeatures
from derender.objectives.perceptual import build_perceptual
from derender.objectives.self_features import SelfFeatures, load_self_features
from derender.settings import Settings
from derender.storage.atomic import atomic_file
from derender.training.batches import random_stream
from derender.training.config import LoopSettings, OptimiserSettings
from derender.training.step import Precision

REGULARISERS = ("delta", "prior")
"""Terms that say nothing of how well a picture is rebuilt."""


class InversionObjective(Settings):
    """Which generator, the weights of the terms, and when which code may differ from the first."""

    generator: str | None = None  # run folder of a stylegan2, or a published .pt file
    perceptual_weight: float = Field(default=0.8, ge=0)
    delta_weight: float = Field(default=5e-5, ge=0)  # the original's 2e-4, whose pictures are -1..1
    prior_weight: float = Field(default=1e-4, ge=0)  # a random code is about 42 (squared) from the mean code
    first_release: int = Field(default=10_000, ge=0)  # pictures until then all layers share one code
    release_every: int = Field(default=2_000, ge=1)  # pictures from one code to the next
    self_features_steps: int = Field(default=600, ge=1)


class E4eConfig(LoopSettings):
    """One training run of an e4e encoder."""

    baseline: Literal["e4e"] = "e4e"
    model: EncoderSettings = EncoderSettings()
    objective: InversionObjective = InversionObjective()
    batch_size: int = Field(default=16, ge=2)
    optimiser: OptimiserSettings = OptimiserSettings(learning_rate=1e-3, weight_decay=0.0)
    channels_last: bool = False


def open_generator(source: str | Path | None) -> Generator:
    """The averaged generator of a run of ours, or a published one (a .pt file).

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: no source, damaged, wants to run code, or no generator.
    """
    if source is None:
        raise ValueError(
            "name the generator to invert, as in --set generator=RUN (a run of derender train --model "
            "stylegan2) or a file of stylegan2-pytorch"
        )
    if Path(source).suffix.lower() == ".pt":
        return load_published_generator(source)
    model = saved_baseline(source, {"stylegan2": (Stylegan, GeneratorSettings)})
    assert isinstance(model, Stylegan)
    return model.generator


def build_e4e(config: E4eConfig) -> E4e:
    """The untrained encoder with the generator that the configuration names and its mean code."""
    generator = open_generator(config.objective.generator)
    model = E4e(E4eSettings(**config.model.model_dump(), generator=generator.settings))
    model.generator.load_state_dict(generator.state_dict())
    model.released.fill_(0)
    centre = generator.mean_w(CENTRE_LATENTS, random_stream(config.seed, "perturb", 0))
    model.centre.copy_(centre.expand_as(model.centre))
    return model


def perceptual_features(
    config: E4eConfig,
    file: Path,
    images: UInt8[Tensor, "n 3 h w"],
    progress: Callable[[int, int], None],
) -> PerceptualFeatures | None:
    """Features learnt from the pictures, kept in ``file`` for a resumed run; None if they have no weight."""
    objective = config.objective
    if objective.perceptual_weight == 0:
        return None
    if file.exists():
        return load_self_features(file).to(images.device)
    features = build_perceptual(
        "self",
        images,
        seed=config.seed,
        steps=objective.self_features_steps,
        progress=lambda done, total, _: progress(done, total),
        device=images.device,
    )
    assert isinstance(features, SelfFeatures)
    with atomic_file(file) as temporary:
        features.save(temporary)
    return features


def released_codes(objective: InversionObjective, images: int) -> int:
    """The number of the last code that may differ from the first after so many pictures."""
    return max(0, (images - objective.first_release) // objective.release_every + 1)


def inversion_losses(
    model: E4e,
    images: Float[Tensor, "n 3 h w"],
    objective: InversionObjective,
    features: PerceptualFeatures | None,
    generator: RandomGenerator,
    precision: Precision,
) -> dict[str, Tensor]:
    """Squared error and perceptual distance of the inversions in 0..1, two regularisers; beside them L1."""
    if model.training:
        model.released.fill_(released_codes(objective, int(model.seen)))
        model.seen += len(images)
    with precision():
        w_plus = model.invert(images)
        again = model.rebuild(w_plus)
    again = adaptive_avg_pool2d(again.float(), images.shape[-1])
    terms = {
        "reconstruction": mse_loss(again, images),
        "delta": objective.delta_weight * code_deltas(w_plus),
        "prior": objective.prior_weight * (w_plus[:, 0] - model.centre[0]).square().sum(dim=1).mean(),
        "l1": (again.detach().clamp(0, 1) - images).abs().mean(),
    }
    if features is not None:
        distance = mse_loss(features(again), features.target(images))
        terms["perceptual"] = objective.perceptual_weight * distance
    return terms


def code_deltas(w_plus: Float[Tensor, "n codes d"]) -> Float[Tensor, ""]:
    """Sum over codes of their mean distance from the first; 0 is a code of W."""
    difference = w_plus[:, 1:] - w_plus[:, :1]
    return (difference.square().sum(dim=2) + 1e-12).sqrt().sum(dim=1).mean()
