"""ResNet-18 trained with a few hundred labels.

Source: He et al., *Deep Residual Learning* (CVPR 2016); the network is transformers' (Apache-2.0), configured
as ResNet-18, with fresh weights: nothing is downloaded. It learns every label column at once, one softmax for
each, on 100, 500 or 1,000 images of the training part. Feature: ``pooled``, the 512 numbers before the
classifier. Leaves out pre-training.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from pydantic import Field, field_validator
from torch import Generator, Tensor
from torch.nn.functional import cross_entropy

from derender.baselines.augment import AugmentSettings, augment
from derender.baselines.model import BaselineModel, BaselineSettings, Images, optional
from derender.baselines.training import ShortRun
from derender.data import ImageSet, as_float, split_indices
from derender.features import map_batches, missing
from derender.settings import Settings
from derender.training.task import TrainResult

MILD = AugmentSettings(crop_from=0.7, jitter=0.5, hue_deg=0.0, grey=0.0, blur=0.0)
"""Views of labelled images: a little crop, flip and jitter."""


class Resnet18Settings(BaselineSettings):
    """The classes that the network distinguishes: the class names of every label column."""

    image_size: int = Field(default=64, ge=32)
    width: int = Field(default=64, ge=1)  # of the first stage; each of the three others doubles it
    classes: dict[str, tuple[str, ...]]


class SupervisedConfig(Settings):
    """One training: AdamW, the rate falling along a cosine to 0; no validation, no early stop."""

    baseline: Literal["resnet18"] = "resnet18"
    labels: tuple[str, ...] = ()  # label columns to learn; at least one
    labelled: int = Field(default=1_000, ge=2)  # images whose labels are used
    image_size: int = Field(default=64, ge=32)
    width: int = Field(default=64, ge=1)
    epochs: int = Field(default=30, ge=1)
    batch_size: int = Field(default=32, ge=2)
    learning_rate: float = Field(default=1e-3, gt=0)
    weight_decay: float = Field(default=0.05, ge=0)
    augment: AugmentSettings = MILD
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)  # train, validation, test
    seed: int = Field(default=0, ge=0)

    @field_validator("labels", mode="before")
    @classmethod
    def _one_or_many(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value


class Resnet18(BaselineModel):
    """ResNet-18. Features: ``pooled`` (512 numbers) and ``logits`` (one for every class)."""

    name, settings_type, config_type = "resnet18", Resnet18Settings, SupervisedConfig
    features = ("pooled", "logits")
    settings: Resnet18Settings

    def __init__(self, settings: Resnet18Settings):
        super().__init__(settings)
        library = optional("transformers", "the baseline resnet18")
        shape = library.ResNetConfig(
            num_channels=3,
            embedding_size=settings.width,
            hidden_sizes=[settings.width * 2**stage for stage in range(4)],
            depths=[2, 2, 2, 2],
            layer_type="basic",
            num_labels=sum(len(names) for names in settings.classes.values()),
        )
        self.net = library.ResNetForImageClassification(shape)

    def pooled(self, images: Images) -> Float[Tensor, "n d"]:
        """The mean over places of the last feature map, for images in 0..1."""
        return self.net.resnet(images * 2 - 1).pooler_output.flatten(1)

    def logits(self, images: Images) -> Float[Tensor, "n classes"]:
        """One number for every class of every label, label after label."""
        return self.net.classifier(self.pooled(images))

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        pooled = self.pooled(images)
        return {"pooled": pooled, "logits": self.net.classifier(pooled)}


def labelled_rows(images: ImageSet, config: SupervisedConfig) -> np.ndarray:
    """Rows of the images to learn from: of the training part, drawn by the seed, every label known.

    Raises:
        ValueError: there are fewer than asked for, or no label was named.
    """
    if not config.labels:
        known = ", ".join(images.labels) or "no labels"
        raise ValueError(f"name a label to learn, as in --set labels=NAME; the images have {known}")
    train = split_indices(images.files, config.split, seed=config.seed).train
    known = ~np.any([missing(images.label(name)[train]) for name in config.labels], axis=0)
    rows = np.random.default_rng(config.seed).permutation(train[known])
    if len(rows) < config.labelled:
        raise ValueError(
            f"{config.labelled:,} labelled images were requested, the training part has {len(rows):,} "
            f"with {', '.join(config.labels)}: set labelled={len(rows)} or fewer"
        )
    return rows[: config.labelled]


def train_resnet18(
    images: ImageSet,
    config: SupervisedConfig,
    *,
    device: str | torch.device = "cpu",
    progress: Callable[[int, int, float], None] | None = None,
) -> Resnet18:
    """A ResNet-18 trained on ``config.labelled`` images, ready to embed.

    The same seed gives the same weights; torch's global generator is left as it was.

    Args:
        images: with these labels; only the labelled rows are used.
        config: how.
        device: where.
        progress: called with (images seen, in all, loss) after every step.
    """
    rows = labelled_rows(images, config)
    names, targets = encode_labels(images, config.labels, rows)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        size = images.images.shape[-1]
        model = Resnet18(Resnet18Settings(image_size=size, width=config.width, classes=names))
    inputs, wanted = as_float(images.images[rows]).to(device), targets.to(device)
    model = model.to(device).train()
    optimiser = torch.optim.AdamW(model.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    batch = min(config.batch_size, len(rows))
    per_epoch = len(rows) // batch
    total = config.epochs * per_epoch
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, total)
    generator, sizes = Generator().manual_seed(config.seed), [len(found) for found in names.values()]
    for epoch in range(config.epochs):
        order = torch.randperm(len(rows), generator=generator).to(device)
        for within in range(per_epoch):
            chosen = order[within * batch : (within + 1) * batch]
            seen = augment(inputs[chosen], config.augment, generator)
            loss = label_loss(model.logits(seen), wanted[chosen], sizes)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
            if progress is not None:
                progress((epoch * per_epoch + within + 1) * batch, total * batch, loss.item())
    return model.eval().requires_grad_(False)


def encode_labels(
    images: ImageSet, labels: tuple[str, ...], rows: np.ndarray
) -> tuple[dict[str, tuple[str, ...]], Int64[Tensor, "n labels"]]:
    """Class names of every label among these rows, in order, and each row's class numbers."""
    names, columns = {}, []
    for label in labels:
        values = images.label(label)[rows]
        classes, numbers = np.unique(values, return_inverse=True)
        if len(classes) < 2:
            raise ValueError(f"label {label!r} has one value only ({classes[0]}) in {len(rows)} images")
        names[label] = tuple(str(value) for value in classes)
        columns.append(torch.from_numpy(numbers.reshape(-1).astype(np.int64)))
    return names, torch.stack(columns, dim=1)


def label_loss(
    logits: Float[Tensor, "n classes"], targets: Int64[Tensor, "n labels"], sizes: list[int]
) -> Float[Tensor, ""]:
    """Cross entropy among every label's own classes, mean over labels; at least 0."""
    parts = logits.split(sizes, dim=1)
    return torch.stack([cross_entropy(part, targets[:, i]) for i, part in enumerate(parts)]).mean()


def accuracy(model: Resnet18, images: ImageSet) -> dict[str, float]:
    """Share of right answers for every label among images where it is known, 0 to 1; NaN if nowhere."""
    parts = map_batches(lambda batch: model.logits(batch).cpu().numpy(), model, images.images, batch_size=256)
    answers, found, start = np.concatenate(parts), {}, 0
    for label, names in model.settings.classes.items():
        values = images.label(label)
        known = ~missing(values)
        best = np.array(names)[answers[:, start : start + len(names)].argmax(axis=1)]
        right = best[known] == values[known].astype(str)
        found[label] = float(right.mean()) if known.any() else float("nan")
        start += len(names)
    return found


def train_supervised(
    config: SupervisedConfig, images: ImageSet, out: str | Path, *, sample_sheet: Any = None, **how: Any
) -> TrainResult:
    """Train into a new run folder; see `registry.train_baseline`. Minutes, no resume, no sample sheet.

    Raises:
        FileExistsError: the folder is not empty.
        ValueError: too few images with these labels.
    """
    labelled_rows(images, config)  # wrong labels are an error before a folder is made
    optional("transformers", "the baseline resnet18")
    run, seen = ShortRun(config, images, out, **how), 0

    def note(done: int, total: int, loss: float) -> None:
        nonlocal seen
        seen = done
        run.note(done, total, {"loss": loss})
        run.record("train", done, {"loss": loss, "images_per_second": done / run.seconds})

    model = train_resnet18(images, config, device=run.accelerator, progress=note)
    scores = {}
    if len(run.split.validation):
        right = accuracy(model, images.select(run.split.validation))
        scores = {f"accuracy {label}": value for label, value in right.items()}
        run.record("validation", seen, scores)
    return run.finish(model, seen, scores)
