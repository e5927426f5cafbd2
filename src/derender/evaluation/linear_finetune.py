"""The paper's head trained together with the encoders under it: models, baselines, and untrained controls.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.4 and Table 2 ("Finetune"). Encoders and head share Adam 2e-4,
    100 epochs and batches of 64, as the frozen head. The paper does not say whether the encoders had a rate
    of their own. Of a baseline the whole network is trained; a ResNet-18 with fresh weights is the paper's
    supervised row. An untrained model under the same protocol is the control: a supervised training from
    nothing. Controls without an encoder (pixels, principal components) have nothing below the head to train:
    theirs are the answers of the head alone. Leaves out the rendering objective beside the task.
"""

import copy
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from derender.baselines.controls import untrained_twin
from derender.data import as_float
from derender.evaluation.controls import UNTRAINED
from derender.evaluation.feature_rows import ModelSource, Prepared, opened
from derender.evaluation.linear_probes import PAPER_HEAD, HeadSettings, head_loss, probabilities, probe_runs
from derender.evaluation.linear_task import Rows, Task
from derender.evaluation.options import Options
from derender.features import model_fingerprint
from derender.inputs import Progress, device_named
from derender.model import Derenderer

SUPERVISED = "ResNet-18, supervised"


def finetune(
    model: Any,
    images: np.ndarray,
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    *,
    factors: Sequence[str] = ("geometry", "albedo"),
    seed: int = 0,
    settings: HeadSettings = PAPER_HEAD,
    progress: Progress | None = None,
) -> np.ndarray:
    """Train copies of the factors' encoders with a new head, answer for the test rows: (T, A) probabilities.

    The model, ours or a baseline, stays as it was. ``images`` are (N, 3, H, W) uint8, ``rows`` (n,) training
    rows. The seed is of the head's start and the order of images. ``progress`` is called with (epochs done,
    epochs in all). A ValueError: features without a gradient.
    """
    device = model.device
    ours = isinstance(model, Derenderer)
    chosen = {name: model.nets[name] for name in factors} if ours else {"whole": model}
    nets: Any = nn.ModuleDict(copy.deepcopy(chosen)).to(device)
    nets.requires_grad_(True).train()

    def embed(numbers: np.ndarray) -> torch.Tensor:
        pictures = as_float(np.ascontiguousarray(images[numbers])).to(device)
        if not ours:
            return torch.cat([*nets["whole"].embed(pictures).values()], dim=1)
        return torch.cat([net.encode(pictures) for net in nets.values()], dim=1)

    generator = torch.Generator().manual_seed(seed)
    targets = torch.from_numpy(task.targets).float().to(device)
    first = embed(rows[:2])
    if not first.requires_grad:
        raise ValueError(f"features of {type(model).__name__} have no gradient: leave it out of finetune")
    width = first.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = nn.Linear(width, targets.shape[1]).to(device)
    optimiser = torch.optim.Adam([*nets.parameters(), *head.parameters()], lr=settings.learning_rate)
    for epoch in range(settings.epochs):
        order = rows[torch.randperm(len(rows), generator=generator).numpy()]
        for start in range(0, len(order), settings.batch_size):
            batch = order[start : start + settings.batch_size]
            loss = head_loss(head(embed(batch))[None], targets[batch][None], task.kind).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        if progress is not None:
            progress(epoch + 1, settings.epochs)
    nets.eval()
    with torch.inference_mode():
        parts = np.array_split(tested, max(1, len(tested) // 256))
        return np.concatenate([probabilities(head(embed(part)), task.kind).cpu().numpy() for part in parts])


def finetuned_answers(
    models: Mapping[str, Sequence[ModelSource]],
    ready: Prepared,
    task: Task,
    split: Rows,
    seeds: Sequence[int],
    settings: HeadSettings,
    options: Options,
    supervised: bool = False,
) -> dict[str, dict[int, np.ndarray]]:
    """By row name and number of labels, (S, T, A) answers: models, untrained ones, and other controls' heads.

    ``supervised`` adds a ResNet-18 with fresh weights.

    Seed s trains run s of a model modulo their number. Controls of ``ready`` without an encoder answer by the
    head alone; ``options`` hold the images and the factors whose encoders are trained.
    """

    def answers(model: Any, count: int, at: int, what: str) -> np.ndarray:
        rows, images = split.train[count][at], options.at(model.image_size, ready.table.files).images
        own = [factor.name for factor in model.factors] if isinstance(model, Derenderer) else model.chosen
        chosen = list((isinstance(model, Derenderer) and options.chosen) or own)
        inputs = {
            "weights": model_fingerprint(model), "images": images, "targets": task.targets, "kind": task.kind,
            "rows": rows, "tested": split.test, "seed": seeds[at], "factors": chosen,
            "settings": settings.model_dump(),
        }  # fmt: skip
        progress = options.stage(f"fine-tuning {what}, {count:,} labels, seed {seeds[at]}", "epochs")
        how: dict[str, Any] = {"seed": seeds[at], "settings": settings, "progress": progress}
        learn = partial(finetune, model, images, task, rows, split.test, factors=chosen, **how)
        return options.memory.recall_one("finetuned", inputs, learn)

    trained = {name: [opened(run, options.device) for run in runs] for name, runs in models.items()}
    first = next((run for runs in trained.values() for run in runs if isinstance(run, Derenderer)), None)
    if first is not None:
        trained[UNTRAINED] = [untrained_twin(first, seed) for seed in seeds]
    if supervised:
        from derender.baselines.supervised import fresh_resnet18

        size = next(iter(trained.values()))[0].image_size
        trained[SUPERVISED] = [fresh_resnet18(size, seed).to(device_named(options.device)) for seed in seeds]
    found = {
        name: {
            count: np.stack([answers(runs[at % len(runs)], count, at, name) for at in range(len(seeds))])
            for count in split.train
        }
        for name, runs in trained.items()
    }
    for name in ready.controls:
        if not name.startswith(UNTRAINED):
            asked = partial(probe_runs, "linear", ready.features[name], task)
            how = (split.test, seeds, settings, options.memory)
            found[name] = {count: asked(rows, *how) for count, rows in split.train.items()}
    return found
