"""Baselines that the training loop trains: one row each, and the task that joins a row to the loop.

Runs, checkpoints, exact resume, early stop and reports are those of our own model (training/loop.py).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float, UInt8
from torch import Generator, Tensor, nn

from derender.baselines.autoencoder import (
    Autoencoder,
    AutoencoderConfig,
    AutoencoderSettings,
    BetaVae,
    BetaVaeConfig,
    autoencoder_losses,
    beta_vae_losses,
)
from derender.baselines.model import BaselineModel, BaselineSettings, saved_baseline
from derender.baselines.ris.building import RisConfig
from derender.baselines.ris.model import Ris, RisSettings
from derender.baselines.simclr import Simclr, SimclrConfig, SimclrSettings, make_views, simclr_losses
from derender.baselines.stylegan2.adversarial import (
    ADVERSARIAL_TERMS,
    Stylegan,
    StyleganConfig,
    adversarial_losses,
)
from derender.baselines.stylegan2.e4e import E4e, E4eSettings
from derender.baselines.stylegan2.generator import GeneratorSettings
from derender.baselines.stylegan2.inversion import (
    REGULARISERS,
    E4eConfig,
    build_e4e,
    inversion_losses,
    perceptual_features,
)
from derender.baselines.supervised import Resnet18, Resnet18Settings, SupervisedConfig
from derender.baselines.vqvae import Vqvae, VqvaeConfig, VqvaeSettings, vqvae_losses
from derender.data import suggestion
from derender.training.batches import random_stream
from derender.training.config import LoopSettings, TrainConfig
from derender.training.finetune_config import FinetuneConfig
from derender.training.finite import first_not_finite
from derender.training.run_folder import RunFolder, read_config, read_config_tree
from derender.training.step import Precision
from derender.training.step_module import Held
from derender.training.task import PhaseProgress
from derender.training.watch import Finding

Losses = Callable[[Any, Tensor, Generator, Precision], dict[str, Tensor]]
"""(model, pictures in 0..1, generator, precision) to losses and other numbers by name."""
Shown = Callable[[Any, Tensor], dict[str, Tensor]]
"""(model, pictures in 0..1) to pictures by column."""

Row = TypeVar("Row")

OUTSIDE_LOSS = ("l1", "codes_used", "active", "found")  # numbers beside the losses


@dataclass(frozen=True)
class TrainedBaseline:
    """One row.

    Attributes:
        config: settings of a run; its ``baseline`` is the name, its ``model`` the module's settings.
        module: the network, made from ``settings``.
        losses: makes the function of a batch, given the configuration and the device.
        shown: makes the function of a sample sheet, given the same.
        not_judged: losses that say nothing of held-out pictures.
        build: makes the network of a configuration, where it takes more than the module's settings.
        prepare: makes the function of a batch where that needs pictures to learn from first, given the
            configuration, a file that keeps what was learnt, the pictures and the progress.
    """

    config: type[LoopSettings]
    module: type[BaselineModel]
    settings: type[BaselineSettings]
    losses: Callable[[Any, torch.device], Losses]
    shown: Callable[[Any, torch.device], Shown]
    not_judged: tuple[str, ...] = ()
    build: Callable[[Any], BaselineModel] | None = None
    prepare: Callable[[Any, Path, Tensor, PhaseProgress], Losses] | None = None


def _vqvae(config: VqvaeConfig, device: torch.device) -> Losses:
    return lambda model, images, generator, precision: vqvae_losses(
        model, images, config.objective, generator, precision
    )


def _autoencoder(config: AutoencoderConfig, device: torch.device) -> Losses:
    return lambda model, images, generator, precision: autoencoder_losses(model, images, precision)


def _beta_vae(config: BetaVaeConfig, device: torch.device) -> Losses:
    return lambda model, images, generator, precision: beta_vae_losses(
        model, images, config.objective, generator, precision
    )


def _simclr(config: SimclrConfig, device: torch.device) -> Losses:
    views = make_views(config.objective, config.model.image_size, device)
    return lambda model, images, generator, precision: simclr_losses(
        model, images, config.objective, views, generator, precision
    )


def _simclr_shown(config: SimclrConfig, device: torch.device) -> Shown:
    views = make_views(config.objective, config.model.image_size, device)

    def shown(model: Simclr, images: Tensor) -> dict[str, Tensor]:
        generator = random_stream(config.seed, "perturb", 0)
        return {"input": images, **{f"view {n}": views(images, generator) for n in (1, 2, 3, 4)}}

    return shown


def _stylegan2(config: StyleganConfig, device: torch.device) -> Losses:
    return lambda model, images, generator, precision: adversarial_losses(
        model, images, config.objective, generator, precision
    )


def _e4e(config: E4eConfig, device: torch.device) -> Losses:
    return lambda model, images, generator, precision: inversion_losses(
        model, images, config.objective, None, generator, precision
    )


def _e4e_prepared(config: E4eConfig, file: Path, images: Tensor, progress: PhaseProgress) -> Losses:
    features = perceptual_features(config, file, images, progress)
    return lambda model, images, generator, precision: inversion_losses(
        model, images, config.objective, features, generator, precision
    )


def _own_pictures(config: LoopSettings, device: torch.device) -> Shown:
    return lambda model, images: model.shown(images)


TRAINED: dict[str, TrainedBaseline] = {
    "vqvae": TrainedBaseline(
        VqvaeConfig, Vqvae, VqvaeSettings, _vqvae, _own_pictures, not_judged=("codebook", "commitment")
    ),
    "simclr": TrainedBaseline(SimclrConfig, Simclr, SimclrSettings, _simclr, _simclr_shown),
    "ae": TrainedBaseline(AutoencoderConfig, Autoencoder, AutoencoderSettings, _autoencoder, _own_pictures),
    "beta-vae": TrainedBaseline(BetaVaeConfig, BetaVae, AutoencoderSettings, _beta_vae, _own_pictures),
    "stylegan2": TrainedBaseline(
        StyleganConfig, Stylegan, GeneratorSettings, _stylegan2, _own_pictures, not_judged=ADVERSARIAL_TERMS
    ),
    "e4e": TrainedBaseline(
        E4eConfig,
        E4e,
        E4eSettings,
        _e4e,
        _own_pictures,
        not_judged=REGULARISERS,
        build=build_e4e,
        prepare=_e4e_prepared,
    ),
}


CONFIGS: dict[str, type[LoopSettings] | type[SupervisedConfig] | type[RisConfig]] = {
    **{name: row.config for name, row in TRAINED.items()},
    "resnet18": SupervisedConfig,
    "ris": RisConfig,
}
"""Settings of a run of every baseline that is trained here."""
MODULES: dict[str, tuple[type[BaselineModel], type[BaselineSettings]]] = {
    **{name: (row.module, row.settings) for name, row in TRAINED.items()},
    "resnet18": (Resnet18, Resnet18Settings),
    "ris": (Ris, RisSettings),
}
"""Module and settings of every baseline that lies in a folder of ours."""


def named_baseline(name: str, rows: Mapping[str, Row]) -> Row:
    """The entry of that name, or an error that names the nearest one."""
    if name not in rows:
        raise ValueError(f"no baseline {name!r}{suggestion(name, rows)}: choose one of {', '.join(rows)}")
    return rows[name]


def load_baseline(source: str | Path, name: str | None = None) -> BaselineModel:
    """The baseline in a run folder or a saved folder, ready to embed; of that name, if one is given.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is a pickle, damaged, of another architecture or another baseline.
    """
    return saved_baseline(source, MODULES if name is None else {name: named_baseline(name, MODULES)})


def read_any_config(path: Path) -> LoopSettings | SupervisedConfig | RisConfig:
    """The configuration of a run, whether it trained our model or a baseline."""
    tree = read_config_tree(path)
    name, ours = tree.get("baseline"), FinetuneConfig if "target" in tree else TrainConfig
    return read_config(path, ours if name is None else named_baseline(str(name), CONFIGS))


@dataclass(frozen=True)
class BaselineTask:
    """Train a baseline as its configuration says."""

    config: Any

    @property
    def row(self) -> TrainedBaseline:
        return named_baseline(self.config.baseline, TRAINED)

    @property
    def outside_loss(self) -> tuple[str, ...]:
        """What held-out pictures are not judged by."""
        return (*OUTSIDE_LOSS, *self.row.not_judged)

    def check(self) -> None:
        """A missing package or model is an error before a folder is made."""
        self.build()
        self.row.losses(self.config, torch.device("cpu"))

    def build(self) -> BaselineModel:
        """The untrained network; torch's global generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed)
            build = self.row.build
            return self.row.module(self.config.model) if build is None else build(self.config)

    def step_module(
        self,
        model: nn.Module,
        run: RunFolder,
        images: UInt8[Tensor, "n 3 h w"],
        progress: PhaseProgress,
    ) -> "BaselineStep":
        prepare = self.row.prepare
        if prepare is None:
            return BaselineStep(model, self.row.losses(self.config, images.device))
        return BaselineStep(model, prepare(self.config, run.perceptual, images, progress))

    def watch(self, memory: dict[str, Any]) -> "FiniteWatch":
        """Stops a run whose loss is no longer a number."""
        return FiniteWatch()

    def shown(self, model: BaselineModel, images: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        """Pictures for a sample sheet, by column."""
        return self.row.shown(self.config, images.device)(model, images)


@dataclass(frozen=True)
class BaselineLosses:
    """Losses of one batch: what is minimised, and every number by name, detached."""

    total: Tensor
    terms: dict[str, Tensor]


class BaselineStep(nn.Module):
    """A baseline and its losses; a batch goes in, the total and the result come out."""

    def __init__(self, model: nn.Module, losses: Losses):
        super().__init__()
        self.model, self.losses = model, losses

    def forward(
        self, images: Tensor, generator: Generator, precision: Precision, done: float | None = None
    ) -> tuple[Tensor, Held]:
        terms = self.losses(self.model, images, generator, precision)
        total = torch.stack([term for name, term in terms.items() if name not in OUTSIDE_LOSS]).sum()
        return total, Held(BaselineLosses(total, {name: term.detach() for name, term in terms.items()}))


@dataclass
class FiniteWatch:
    """Watches for a loss that is not finite."""

    uneasy: bool = field(default=False, init=False)

    def look(self, images: int, result: BaselineLosses) -> tuple[Finding, ...]:
        """A fatal finding once the loss is not finite."""
        loss = result.total.item()
        if isfinite(loss):
            return ()
        broken = first_not_finite(result.terms.items())
        first = "" if broken is None else f"; the first term that is not finite is {broken!r}"
        return (
            Finding("non-finite loss", f"the loss is {loss}{first}", "use a smaller learning_rate", True),
        )

    def memory(self) -> dict[str, Any]:
        """Nothing: a finite loss leaves nothing to remember."""
        return {}
