"""Our own model as a task of the training loop: pictures taken apart, rendered again, and watched."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from derender.model import Derenderer, load
from derender.objectives import load_vgg16
from derender.training.config import TrainConfig
from derender.training.distributed import ALONE, Ranks
from derender.training.finite import first_not_finite, stages_of
from derender.training.perceptual import prepare_perceptual
from derender.training.run_folder import RunFolder
from derender.training.step import StepResult
from derender.training.step_module import StepModule
from derender.training.task import PhaseProgress, Task
from derender.training.validate import NOT_RECONSTRUCTION
from derender.training.watch import Finding, Watcher
from derender.training.weights import fit_weights


@dataclass(frozen=True)
class DerenderTask:
    """Train a `Derenderer` as the configuration says.

    ``begins`` is false where a checkpoint gives the weights: then the model to start from is not needed.
    """

    config: TrainConfig
    begins: bool = True
    ranks: Ranks = ALONE
    outside_loss: tuple[str, ...] = NOT_RECONSTRUCTION

    @property
    def all_learn(self) -> bool:
        """Whether every parameter gets a gradient in every step: both heads of the confidence net do."""
        objective = self.config.objective
        return objective.confidence and objective.perceptual != "none" and objective.perceptual_weight > 0

    def check(self) -> None:
        """Missing perceptual weights are an error before a folder is made."""
        if self.config.objective.perceptual == "vgg16":
            load_vgg16(self.config.objective.vgg16_path)

    def build(self) -> Derenderer:
        """The model as the run begins: untrained, or with the weights of ``start_from``.

        Raises:
            FileNotFoundError: there is no model to start from.
            ValueError: its weights do not fit this one's settings; names the first.
        """
        model = Derenderer.seeded(self.config.model, self.config.seed)
        start = self.config.start_from
        if start is not None and self.begins:
            try:
                weights = load(start).state_dict()
                fit_weights(model, {k: v for k, v in weights.items() if not k.startswith("unet_decoder.")})
            except ValueError as error:
                raise ValueError(
                    f"cannot start from {start}: {error}; leave its network settings as they are"
                ) from error
        return model

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
        return StepModule(model, self.config.objective, perceptual, self.ranks, self.config.accumulate)

    def watch(self, memory: dict[str, Any]) -> "SceneWatch":
        """The collapse detector."""
        watcher = Watcher.remembering(self.config.model.ranges, self.config.batch_size, memory)
        watcher.ranks = self.ranks
        return SceneWatch(watcher)


def sharing_batches(task: Task, ranks: Ranks) -> Task:
    """The task as one of several ranks does it.

    Raises:
        ValueError: the batch cannot be shared evenly, or what is trained needs it whole.
    """
    if ranks.count == 1:
        return task
    ranks.check(task.config.batch_size)
    if not isinstance(task, DerenderTask):
        raise ValueError("a baseline trains on one device: start it without torchrun")
    return replace(task, ranks=ranks)


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
        broken = first_not_finite(stages_of(result))
        shared = self.watcher.ranks.mean({"loss": result.total.item(), "broken": float(broken is not None)})
        if shared["broken"] and broken is None:
            broken = "that of another rank"
        return self.watcher.look(images, shared["loss"], result.scene, broken)

    def memory(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return self.watcher.memory()
