"""Our own model as a task of the training loop: pictures taken apart, rendered again, and watched."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from derender.model import Derenderer
from derender.objectives import load_vgg16
from derender.training.config import TrainConfig
from derender.training.perceptual import prepare_perceptual
from derender.training.run_folder import RunFolder
from derender.training.step import StepResult
from derender.training.step_module import StepModule
from derender.training.task import PhaseProgress
from derender.training.validate import NOT_RECONSTRUCTION
from derender.training.watch import Finding, Watcher


@dataclass(frozen=True)
class DerenderTask:
    """Train a `Derenderer` as the configuration says."""

    config: TrainConfig
    outside_loss: tuple[str, ...] = NOT_RECONSTRUCTION

    def check(self) -> None:
        """Missing perceptual weights are an error before a folder is made."""
        if self.config.objective.perceptual == "vgg16":
            load_vgg16(self.config.objective.vgg16_path)

    def build(self) -> Derenderer:
        """The untrained model."""
        return Derenderer.seeded(self.config.model, self.config.seed)

    def step_module(
        self,
        model: nn.Module,
        run: RunFolder,
        images: UInt8[Tensor, "n 3 h w"],
        progress: PhaseProgress,
    ) -> StepModule:
        """The step with the run's perceptual features, learnt first where there are none yet."""
        assert isinstance(model, Derenderer)
        perceptual = prepare_perceptual(
            self.config, run.perceptual, images, lambda done, total, _: progress(done, total)
        )
        if self.config.channels_last and perceptual is not None:
            perceptual = perceptual.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        return StepModule(model, self.config.objective, perceptual)

    def watch(self, memory: dict[str, Any]) -> "SceneWatch":
        """The collapse detector."""
        return SceneWatch(Watcher.remembering(self.config.model.ranges, memory))


@dataclass(frozen=True)
class SceneWatch:
    """The collapse detector, looking at a step's result."""

    watcher: Watcher

    @property
    def uneasy(self) -> bool:
        """Whether a fatal sign is on."""
        return self.watcher.uneasy

    def look(self, images: int, result: StepResult) -> tuple[Finding, ...]:
        """What is wrong with the scenes of this batch; usually nothing."""
        return self.watcher.look(images, result.total.item(), result.scene)

    def memory(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return self.watcher.memory()
