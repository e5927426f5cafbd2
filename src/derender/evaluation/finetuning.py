"""Joint training as a task of the training loop: the rendering objective and labels, one total.

Source: Klinghoffer et al., ECCV 2022, Sec. 3.1, as future work. Images without a label take part in the
rendering objective alone. Held-out images are judged by the labels, which so choose the saved weights.

The test part of the run's own split is scored; neither training nor the choice of weights saw it. Heads on
frozen features and on controls learn from the very same labels. Leaves out weights of classes, and a rate of
its own for the head.
"""

import copy
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Generator, Tensor, nn

from derender.baselines.supervised import drawn_labelled
from derender.data import ImageSet, Split, split_indices
from derender.evaluation import bootstrap, feature_rows, linear_probes, linear_task
from derender.evaluation.linear_probing import BOTH, LINEAR_COLUMNS, compare_linear
from derender.evaluation.memory import Memory
from derender.evaluation.options import Options
from derender.evaluation.score_table import Scores, scored_table, verdict
from derender.features import chosen, map_batches, model_fingerprint
from derender.inputs import Progress
from derender.model import Derenderer, load
from derender.storage.atomic import new_folder, write_whole
from derender.storage.bounded import read_json
from derender.storage.tensors import read_tensors, write_tensors
from derender.training.config import FinetuneConfig
from derender.training.derender_task import DerenderTask, require_perceptual
from derender.training.loop import NOT_RECONSTRUCTION
from derender.training.run_folder import RunFolder
from derender.training.task import Losses, PhaseProgress, Precision, StepLosses, TrainingTask
from derender.training.watch import FiniteWatch

HEAD_FILE, HEAD_CONFIG_FILE = "head.safetensors", "head.json"
RENDERING_TERMS = (
    *("photometric", "photometric_flip", "perceptual", "perceptual_flip"),
    *("smoothness", "curvature", "raised", "lean", *NOT_RECONSTRUCTION),
)


class TargetHead(nn.Module):
    """One linear layer on the factors' codes, standardised: every dimension with mean 0 and variance 1.

    ``kind`` is "labels" (yes or no, each apart) or "classes" (one of several), ``names`` are theirs.
    """

    def __init__(self, factors: Sequence[str], width: int, kind: str, names: Sequence[str]):
        super().__init__()
        self.factors, self.kind, self.names = tuple(factors), kind, tuple(names)
        self.standardise = nn.BatchNorm1d(width, affine=False)
        self.linear = nn.Linear(width, len(self.names))

    def forward(self, codes: Mapping[str, Tensor]) -> Float[Tensor, "n outputs"]:
        """Logits from codes by factor."""
        return self.linear(self.standardise(torch.cat([codes[name].float() for name in self.factors], dim=1)))


class FinetunedModel(nn.Module):
    """A `Derenderer` and a head on its codes."""

    def __init__(self, model: Derenderer, head: TargetHead):
        super().__init__()
        self.model, self.head = model, head

    @property
    def device(self) -> torch.device:
        return self.model.device

    @property
    def image_size(self) -> int:
        return self.model.image_size

    def predict(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n outputs"]:
        """Probabilities for images in 0..1: of each label, or of every class."""
        return linear_probes.probabilities(self.head(self.model.encode(images)), self.head.kind)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write a folder that `derender.load` takes, the head beside the model; complete or not at all."""
        about = {"factors": self.head.factors, "kind": self.head.kind, "names": self.head.names}
        with new_folder(folder, overwrite=overwrite) as temporary:
            self.model.save(temporary, overwrite=True)
            write_tensors(self.head.state_dict(), temporary / HEAD_FILE)
            (temporary / HEAD_CONFIG_FILE).write_text(json.dumps(about, indent=1))
        return Path(folder)


def load_finetuned(source: str | Path, *, device: str | torch.device = "cpu") -> FinetunedModel:
    """A run folder of `derender finetune`, or its ``model``, ready to predict.

    Raises:
        FileNotFoundError: there is no model, or none with a head.
        ValueError: it is damaged.
    """
    model, folder = load(source, device=device), Path(source)
    folder = folder if (folder / HEAD_FILE).is_file() else folder / "model"
    if not (folder / HEAD_FILE).is_file():
        raise FileNotFoundError(f"{source} has no head ({HEAD_FILE}): give a run made by 'derender finetune'")
    try:
        about = read_json(folder / HEAD_CONFIG_FILE, dict[str, str | tuple[str, ...]])
        width = model.settings.network.code_size * len(about["factors"])
        head = TargetHead(about["factors"], width, about["kind"], about["names"])
        head.load_state_dict(read_tensors(folder / HEAD_FILE))
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"the head in {folder} is damaged: copy or train the model again") from error
    return FinetunedModel(model, head.to(device)).eval().requires_grad_(False)


@dataclass(frozen=True)
class JointLabels:
    """The labels of all images, and (N, A) those that training may see. The latter are -1 for training images
    beyond those labelled and for all tested ones. ``split`` is the run's own; its test part is never seen."""

    asked: linear_task.Task
    visible: np.ndarray
    split: Split


def target_of(images: ImageSet, config: FinetuneConfig) -> JointLabels:
    """The labels that a configuration names, from an image set.

    Raises:
        ValueError: no label, unknown ones, one class, or fewer labelled images than requested.
    """
    target = config.target
    if not target.labels:
        raise ValueError(f"name a label to learn; the images have {', '.join(images.labels) or 'no labels'}")
    names = ", ".join(target.labels)
    asked = linear_task.task_of({name: images.label(name) for name in target.labels})
    split = split_indices(images.files, config.split, seed=config.seed)
    labelled = split.train[asked.known[split.train]]
    if target.labelled is not None:
        labelled = drawn_labelled(labelled, target.labelled, config.seed, names)
    known = asked.targets[labelled]
    if not ((known == 1).any(axis=0) & (known == 0).any(axis=0)).any():
        what = f"the {len(labelled)} labelled images to learn from have one class of {names} only"
        raise ValueError(f"{what}: use more of them, or another seed")
    visible = np.full_like(asked.targets, -1)
    for rows in (labelled, split.validation):
        visible[rows] = asked.targets[rows]
    return JointLabels(asked, visible, split)


@dataclass(frozen=True)
class FinetuneTask(TrainingTask):
    """Train a `Derenderer` and a head on its codes, on (N, 3, H, W) images; ``start``, the pre-trained model,
    stays as it is (None: fresh weights).
    """

    config: FinetuneConfig  # pyrefly: ignore[bad-override]
    images: UInt8[np.ndarray, "n 3 h w"]
    target: JointLabels
    start: Derenderer | None = None
    outside_loss: tuple[str, ...] = RENDERING_TERMS  # pyrefly: ignore[bad-override]

    def build(self) -> FinetunedModel:
        """The model to start from with a fresh head, the same for the same seed."""
        factors, config, asked = self.config.target.factors, self.config, self.target.asked
        if config.target.rendering_weight > 0:
            require_perceptual(config.objective)
        if self.start is not None and self.start.settings != config.model:
            fix = "leave out settings of model.network and model.ranges"
            raise ValueError(f"the networks of a pre-trained model are given: {fix}")
        model = copy.deepcopy(self.start) or Derenderer.seeded(config.model, config.seed)
        chosen(factors, {factor.name: factor for factor in model.factors})
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            width = config.model.network.code_size * len(factors)
            head = TargetHead(factors, width, asked.kind, asked.names)
        return FinetunedModel(model.cpu(), head).requires_grad_(True).train()

    def losses(
        self, model: FinetunedModel, run: RunFolder, images: UInt8[Tensor, "n 3 h w"], progress: PhaseProgress
    ) -> Losses:
        """Both objectives, with the perceptual features of the run that this one starts from."""
        config, target, head = self.config, self.config.target, model.head
        rendering: Losses | None = None
        if target.rendering_weight > 0:
            if config.start is not None and config.objective.perceptual == "self":
                there = RunFolder(Path(config.start)).perceptual  # its sigmas belong to them
                if there.is_file() and not run.perceptual.exists():
                    write_whole(run.perceptual, there.read_bytes())
            rendering = DerenderTask(config).losses(model.model, run, images, progress)
        known = torch.from_numpy(self.target.visible).float().to(images.device)

        def step(
            batch: Tensor, generator: Generator, precision: Precision, done: float | None, rows: Tensor
        ) -> StepLosses:
            if rendering is None:
                with precision():
                    codes = model.model.encode(batch)
                result = StepLosses(batch.new_zeros(()), {})
            else:
                shared = None if config.start is not None else done  # of a trained model no map is shared
                result: Any = rendering(batch, generator, precision, shared)
                codes = result.codes
            weight = target.rendering_weight
            terms = {name: value if name == "l1" else weight * value for name, value in result.terms.items()}
            labels = known[rows.to(known.device, non_blocking=True)]
            loss = target.weight * linear_probes.head_loss(head(codes)[None], labels[None], head.kind)[0]
            terms["target"] = loss.detach()
            return replace(result, total=weight * result.total + loss, terms=terms)

        return step

    def watch(self, memory: dict[str, Any]) -> FiniteWatch:
        """The collapse detector; where nothing is rendered, a watcher of the loss."""
        if self.config.target.rendering_weight == 0:
            return FiniteWatch()
        return DerenderTask(self.config).watch(memory)


def score_finetuned(
    tuned: FinetunedModel, task: FinetuneTask, *, began: str = "fresh weights",
    resample_count: int = bootstrap.RESAMPLES, memory: Memory | None = None, progress: Progress | None = None,
) -> Scores:  # fmt: skip
    """Held-out scores of ``fine-tuned``, of heads on frozen features and of controls, 0..1, best 1.

    Beside it stand both heads on the frozen features of ``began``, logistic regression on three controls, and
    ``majority``. ``versus`` compares it with the best of these. ``n_unlabelled`` images have none of the
    labels. ``result`` are the ``ScoredRow``; what took long is kept in ``memory``.

    Raises:
        ValueError: no tested image has a label.
    """
    target, seed, kept = task.target, task.config.seed, memory or Memory()
    test = target.split.test[target.asked.known[target.split.test]]
    train = target.split.train[(target.visible[target.split.train] >= 0).any(axis=1)]
    if len(test) < 2:
        fix = "bring more images, or set a larger test share in split="
        raise ValueError(f"the test part has {len(test)} images with a label, two are needed to score: {fix}")

    def answered() -> np.ndarray:
        parts = map_batches(tuned.predict, tuned, task.images[test], batch_size=256)
        return torch.cat(parts).cpu().numpy()

    inputs = {"weights": model_fingerprint(tuned), "kind": target.asked.kind, "images": task.images[test]}
    answers = kept.recall_one("finetuned-answers", inputs, answered)
    learned_and_tested, count = np.concatenate([train, test]), len(train)
    start = (task.start or task.build().model).to(tuned.device)
    parts = (learned_and_tested, target.split.train)
    shown, fitted = (ImageSet(task.images[some], tuple(map(str, some.tolist()))) for some in parts)
    factors, device = task.config.target.factors, tuned.device.type
    options = Options(factors=factors, untrained_seeds=1, seed=seed, device=device, cache=kept)
    runs = {"frozen": [feature_rows.embedded_table(start, shown, options).concatenate(factors)]}
    controls = feature_rows.control_rows(shown, start.settings, options, fit_on=fitted)
    runs |= {row.name: row.arrays() for row in controls}
    asked = target.asked.select(learned_and_tested)
    rows = linear_task.Rows(np.arange(count, len(asked)), {count: np.arange(count)[None]})
    same = {"task": asked, "rows": rows, "seeds": (seed,), "resample_count": resample_count, "memory": kept}
    compared = partial(compare_linear, **same)
    tuned_answers = {"fine-tuned": {count: answers[None]}}
    logistic, joint = compared(runs, heads=("logistic",), finetuned=tuned_answers, progress=progress).parts
    (paper,) = compared({"frozen": runs["frozen"]}, heads=("linear",)).parts
    (ours, majority), (frozen, *likewise, _) = joint.rows, logistic.rows
    beside = {"fine-tuned": ours, "frozen, logistic": frozen, "frozen, paper's head": paper.rows[0]}
    beside |= {f"{row.name}, logistic": row for row in likewise} | {"majority": majority}
    scored = tuple(bootstrap.ScoredRow(name, row is not ours, 1, row.scores) for name, row in beside.items())
    judged = bootstrap.with_verdicts(scored)
    notes = [verdict(judged[0], score, LINEAR_COLUMNS[score]) for score in BOTH]
    unlabelled, names = int((~target.asked.known).sum()), asked.names
    task_name = f"{len(names)} classes" if asked.kind == "classes" else f"mean of {len(names)} yes/no labels"
    split = f"{count:,} labelled images learned, {len(test):,} held out"
    caption = f"{task_name}: {split}; frozen features of {began}"
    if unlabelled:
        caption += f"; {unlabelled:,} images without label never asked"
    table = scored_table(caption, "trained on labels", scored, LINEAR_COLUMNS, intervals=BOTH, deviations=())
    versus = {score: asdict(judged[0].versus[score]) for score in BOTH}
    values = {
        "rows": bootstrap.numbers_of(scored), "versus": versus,
        "kind": asked.kind, "names": names, "n_train": count, "n_test": len(test), "n_unlabelled": unlabelled,
    }  # fmt: skip
    return Scores([table], values, notes, result=scored)
