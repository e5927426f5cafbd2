"""Joint training as a task of the training loop: the rendering objective and labels, one total.

Source: Klinghoffer et al., ECCV 2022, Sec. 3.1, where it is future work ("jointly train a learned
representation with the target task in mind"). Pictures without a label take part in the rendering objective
alone. Held-out pictures are judged by the task, so their labels choose the weights that are kept. Leaves out
weights of classes, and a rate of its own for the head.
"""

import copy
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Generator, Tensor, nn

from derender.data import PictureSet, Split, split_indices, suggestion
from derender.evaluation.finetuning.model import FinetunedModel, TargetHead
from derender.evaluation.finetuning.pixel_labels import PixelLabels
from derender.evaluation.linear_head import head_loss
from derender.evaluation.linear_task import Task, task_of
from derender.model import Derenderer
from derender.objectives.perceptual import PerceptualFeatures
from derender.scene import Scene
from derender.storage.atomic import atomic_file
from derender.training.derender_task import DerenderTask
from derender.training.finetune_config import FinetuneConfig
from derender.training.finite import first_not_finite
from derender.training.perceptual import prepare_perceptual
from derender.training.run_folder import RunFolder
from derender.training.sharing import own_share
from derender.training.step import Precision, training_step
from derender.training.step_module import Held
from derender.training.task import PhaseProgress
from derender.training.validate import NOT_RECONSTRUCTION
from derender.training.watch import Finding, Watcher

RENDERING_TERMS = (
    *("photometric", "photometric_flip", "perceptual", "perceptual_flip", "smoothness", "curvature"),
    *NOT_RECONSTRUCTION,
)


@dataclass(frozen=True)
class Target:
    """What is asked of the pictures, and what training may know of the answers.

    Attributes:
        asked: the labels of all pictures.
        visible: (N, A) the same; -1 for training pictures beyond those labelled, and for all tested ones.
        split: the run's own parts; the test part is never seen by training.
    """

    asked: Task
    visible: np.ndarray
    split: Split


def target_of(pictures: PictureSet, config: FinetuneConfig) -> Target:
    """The labels that the configuration names, hidden where training must not see them.

    Raises:
        ValueError: no or unknown labels, a single class, fewer labelled pictures than asked for, or unknown
            factors.
    """
    target = config.target
    if not target.labels:
        known = ", ".join(pictures.labels) or "no labels"
        raise ValueError(f"name a label to learn; the pictures have {known}")
    asked = task_of({name: pictures.label(name) for name in target.labels})
    split = split_indices(pictures.files, config.split, seed=config.seed)
    labelled = split.train[asked.known[split.train]]
    if target.labelled is not None:
        if target.labelled > len(labelled):
            raise ValueError(
                f"{target.labelled:,} labelled pictures were asked for, the training part has "
                f"{len(labelled):,} with {', '.join(target.labels)}: set labelled={len(labelled)} or fewer"
            )
        labelled = np.random.default_rng(config.seed).permutation(labelled)[: target.labelled]
    if len(labelled) < 2 or not (asked.targets[labelled] == 1).any():
        raise ValueError(
            f"the training part has {len(labelled)} pictures with {', '.join(target.labels)} to learn from: "
            "bring more labelled pictures"
        )
    known = asked.targets[labelled]
    varied = (known == 1).any(axis=0) & ((known == 0).any(axis=0))
    if not varied.any():
        raise ValueError(
            f"the {len(labelled)} labelled pictures to learn from have one class of "
            f"{', '.join(target.labels)} only: use more of them, or another seed"
        )
    visible = np.full_like(asked.targets, -1)
    for rows in (labelled, split.validation):
        visible[rows] = asked.targets[rows]
    return Target(asked, visible, split)


@dataclass(frozen=True)
class FinetuneTask:
    """Train a `Derenderer` and a head on its features.

    Attributes:
        config: how.
        images: (N, 3, H, W) all pictures of the run.
        target: their labels.
        start: the pre-trained model, which stays as it is; None for fresh weights.
    """

    config: FinetuneConfig
    images: UInt8[np.ndarray, "n 3 h w"]
    target: Target
    start: Derenderer | None = None
    outside_loss: tuple[str, ...] = RENDERING_TERMS

    def check(self) -> None:
        """What is missing or does not fit is an error before a folder is made."""
        if self.config.target.rendering_weight > 0:
            DerenderTask(self.config).check()
        if self.start is not None and self.start.settings != self.config.model:
            raise ValueError(
                "the networks of a pre-trained model are given: leave out settings of model.network and "
                "model.ranges"
            )
        known = [factor.name for factor in (self.start or Derenderer(self.config.model)).factors]
        for name in self.config.target.factors:
            if name not in known:
                raise ValueError(f"no factor {name!r}{suggestion(name, known)}: there is {', '.join(known)}")

    def build(self) -> FinetunedModel:
        """The model to start from with a fresh head, the same for the same seed."""
        target, config = self.config.target, self.config
        model = (
            Derenderer.seeded(config.model, config.seed) if self.start is None else copy.deepcopy(self.start)
        )
        width = config.model.network.code_size * len(target.factors)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            head = TargetHead(target.factors, width, self.target.asked.kind, self.target.asked.names)
        return FinetunedModel(model.cpu(), head).requires_grad_(True).train()

    def step_module(
        self,
        model: nn.Module,
        run: RunFolder,
        images: UInt8[Tensor, "n 3 h w"],
        progress: PhaseProgress,
    ) -> "FinetuneStep":
        """The step, with all labels, and with the perceptual features of the run that it starts from."""
        assert isinstance(model, FinetunedModel)
        perceptual = None
        if self.config.target.rendering_weight > 0:
            _bring_perceptual(self.config, run.perceptual)
            perceptual = prepare_perceptual(
                self.config, run.perceptual, images, lambda done, total, _: progress(done, total)
            )
        labels = PixelLabels(self.images, self.target.visible, images.device)
        return FinetuneStep(model, self.config, labels.of, perceptual)

    def watch(self, memory: dict[str, Any]) -> "FinetuneWatch":
        """The collapse detector."""
        return FinetuneWatch(Watcher.remembering(self.config.model.ranges, self.config.batch_size, memory))


@dataclass(frozen=True)
class FinetuneLosses:
    """Losses of one batch.

    Attributes:
        total: what is minimised.
        terms: "target" and the weighted terms of the rendering objective, detached.
        scene: the scenes predicted for the batch, where they are rendered.
    """

    total: Tensor
    terms: dict[str, Tensor]
    scene: Scene | None


@dataclass(frozen=True)
class FinetuneWatch:
    """The collapse detector; where nothing is rendered, it looks for a loss that is not finite."""

    watcher: Watcher

    @property
    def uneasy(self) -> bool:
        """Whether a fatal sign is on."""
        return self.watcher.uneasy

    def look(self, images: int, result: FinetuneLosses) -> tuple[Finding, ...]:
        """What is wrong with this batch; usually nothing."""
        loss = result.total.item()
        stages = [] if result.scene is None else list(result.scene.parameters.items())
        broken = first_not_finite([*stages, *result.terms.items()])
        if result.scene is None:
            first = "" if broken is None else f"; the first term that is not finite is {broken!r}"
            text = f"the loss is {loss}{first}"
            wrong = Finding("non-finite loss", text, "use a smaller learning_rate", True)
            return () if isfinite(loss) else (wrong,)
        return self.watcher.look(images, loss, result.scene, broken)

    def memory(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return self.watcher.memory()


class FinetuneStep(nn.Module):
    """Model, head and both objectives; a batch goes in, the total and the result come out."""

    def __init__(
        self,
        model: FinetunedModel,
        config: FinetuneConfig,
        labels_of: Callable[[Tensor], Tensor],
        perceptual: PerceptualFeatures | None,
    ):
        super().__init__()
        self.model, self.config, self.labels_of, self.perceptual = model, config, labels_of, perceptual

    def forward(
        self, images: Tensor, generator: Generator, precision: Precision, done: float | None = None
    ) -> tuple[Tensor, Held]:
        config, target = self.config, self.config.target
        scene, terms, rendering = None, {}, images.new_zeros(())
        if target.rendering_weight > 0:
            own = 1.0 if done is None or config.start is not None else own_share(config.objective, done)
            result = training_step(
                self.model.model, images, config.objective, self.perceptual, generator, precision, own
            )
            codes, scene, rendering = result.codes, result.scene, target.rendering_weight * result.total
            terms = {
                name: value if name == "l1" else target.rendering_weight * value
                for name, value in result.terms.items()
            }
        else:
            with precision():
                codes = self.model.model.encode(images)
        head = self.model.head
        asked = target.weight * target_loss(head(codes), self.labels_of(images), head.kind)
        total = rendering + asked
        return total, Held(FinetuneLosses(total, {**terms, "target": asked.detach()}, scene))


def target_loss(logits: Float[Tensor, "n a"], targets: Float[Tensor, "n a"], kind: str) -> Float[Tensor, ""]:
    """Mean cross-entropy over pictures with a known class, or over known labels; 0 where none is known.

    ``targets`` are -1 (unknown), 0, 1; for classes one-hot, or all -1.
    """
    if kind == "labels":
        return head_loss(logits[None], targets[None], kind)[0]
    known = (targets >= 0).any(dim=1)
    each = -(logits.log_softmax(dim=1) * targets.clamp(min=0)).sum(dim=1)
    return (each * known).sum() / known.sum().clamp(min=1)


def _bring_perceptual(config: FinetuneConfig, file: Path) -> None:
    """Copy self-trained perceptual features from the run it starts from: its sigmas belong to them."""
    if config.start is None or config.objective.perceptual != "self" or file.exists():
        return
    there = RunFolder(Path(config.start)).perceptual
    if there.is_file():
        with atomic_file(file) as temporary:
            shutil.copyfile(there, temporary)
