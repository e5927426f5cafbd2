"""ResNet-18 trained with a few hundred labels.

Source: He et al., *Deep Residual Learning* (CVPR 2016); the network is transformers' (Apache-2.0), configured
as ResNet-18, with fresh weights: nothing is downloaded. It learns every label column at once, one softmax for
each, on 100, 500 or 1,000 images of the training part. Leaves out pre-training.
"""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import cross_entropy

from derender.baselines.model import BaselineModel, BaselineSettings, Features, Images, ShortRun
from derender.baselines.simclr import AugmentSettings, augment
from derender.data import ImageSet, as_float, split_indices
from derender.features import map_batches, missing
from derender.settings import Names, Settings
from derender.storage.places import optional
from derender.training.task import TrainResult

Classes = dict[str, tuple[str, ...]]  # class names of every label column
MILD = AugmentSettings(crop_from=0.7, jitter=0.5, hue_deg=0.0, grey=0.0, blur=0.0)  # of labelled images


class Resnet18Settings(BaselineSettings):
    """The classes that the network distinguishes."""

    image_size: int = Field(default=64, ge=32)
    width: int = Field(default=64, ge=1)  # of the first stage; each of the three others doubles it
    classes: Classes


class SupervisedConfig(Settings):
    """One training: AdamW, the rate falling along a cosine to 0; no validation, no early stop."""

    baseline: Literal["resnet18"] = "resnet18"
    labels: Names = ()  # label columns to learn; at least one
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


class Resnet18(BaselineModel):
    """ResNet-18. Features: ``pooled`` (the 512 numbers before the classifier), ``logits`` (one per class)."""

    name, settings_type, config_type = "resnet18", Resnet18Settings, SupervisedConfig
    features = ("pooled", "logits")
    settings: Resnet18Settings

    def __init__(self, settings: Resnet18Settings):
        super().__init__(settings)
        library = optional("transformers", "the baseline resnet18")
        shape = library.ResNetConfig(
            num_channels=3, embedding_size=settings.width, depths=[2, 2, 2, 2], layer_type="basic",
            hidden_sizes=[settings.width * 2**stage for stage in range(4)],
            num_labels=sum(map(len, settings.classes.values())),
        )  # fmt: skip
        self.net = library.ResNetForImageClassification(shape)

    def describe(self, images: Images) -> Features:
        pooled = self.net.resnet(images * 2 - 1).pooler_output.flatten(1)
        return {"pooled": pooled, "logits": self.net.classifier(pooled)}

    def label_logits(self, images: Images) -> tuple[Float[Tensor, "n _"], ...]:
        """Scores of the classes, one matrix for each label."""
        sizes = [len(names) for names in self.settings.classes.values()]
        return self.describe(images)["logits"].split(sizes, dim=1)

    @classmethod
    def train_into(
        cls, config: SupervisedConfig, images: ImageSet, out: str | Path, *, sample_sheet: Any = None,
        accelerator: str = "cpu", **how: Any,
    ) -> TrainResult:  # fmt: skip
        """Train on ``config.labelled`` images; see `train_baseline`. No resume, no sample sheet.

        The same seed gives the same weights; torch's global generator is left as it was.
        """
        rows = labelled_rows(images, config)  # wrong labels are an error before a folder is made
        names, targets = encode_labels(images, config.labels, rows)
        model = fresh_resnet18(images.images.shape[-1], config.seed, config.width, names)
        run = ShortRun(config, images, out, accelerator=accelerator, **how)
        inputs, wanted = as_float(images.images[rows]).to(accelerator), targets.to(accelerator)
        model, rate, decay = model.to(accelerator).train(), config.learning_rate, config.weight_decay
        optimiser = torch.optim.AdamW(model.parameters(), rate, weight_decay=decay)
        batch, seen = min(config.batch_size, len(rows)), 0
        each = len(rows) // batch * batch
        total = config.epochs * each
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, total // batch)
        generator = Generator().manual_seed(config.seed)
        for _ in range(config.epochs):
            for chosen in torch.randperm(len(rows), generator=generator)[:each].to(accelerator).split(batch):
                parts = model.label_logits(augment(inputs[chosen], config.augment, generator))
                loss = torch.stack([*map(cross_entropy, parts, wanted[chosen].unbind(1))]).mean()
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
                seen += batch
                run.note(seen, total, {"loss": loss.item()})
                run.record("train", seen, {"loss": loss.item(), "images_per_second": seen / run.seconds})
        model.eval().requires_grad_(False)
        scores = {}
        if len(run.split.validation):
            scores = accuracy(model, images.select(run.split.validation))
            run.record("validation", seen, scores)
        return run.finish(model, seen, scores)


def fresh_resnet18(image_size: int, seed: int, width: int = 64, classes: Classes | None = None) -> Resnet18:
    """A ResNet-18 with fresh weights; torch's global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Resnet18(Resnet18Settings(image_size=image_size, width=width, classes=classes or {}))


def labelled_rows(images: ImageSet, config: SupervisedConfig) -> np.ndarray:
    """Rows of the images to learn from: of the training part, drawn by the seed, every label known."""
    if not config.labels:
        known = ", ".join(images.labels) or "no labels"
        raise ValueError(f"name a label to learn, as in --set labels=NAME; the images have {known}")
    train = split_indices(images.files, config.split, seed=config.seed).train
    known = ~np.any([missing(images.label(name)[train]) for name in config.labels], axis=0)
    return drawn_labelled(train[known], config.labelled, config.seed, ", ".join(config.labels))


def drawn_labelled(rows: np.ndarray, count: int, seed: int, names: str) -> np.ndarray:
    """So many of the training part's rows that have the labels ``names``; fewer are an error."""
    if len(rows) < count:
        fewer = f"the training part has {len(rows):,} with {names}: set labelled={len(rows)} or fewer"
        raise ValueError(f"{count:,} labelled images were requested, {fewer}")
    return np.random.default_rng(seed).permutation(rows)[:count]


def encode_labels(
    images: ImageSet, labels: tuple[str, ...], rows: np.ndarray
) -> tuple[Classes, Int64[Tensor, "n labels"]]:
    """Class names of every label among these rows, in order, and each row's class numbers."""
    names, columns = {}, []
    for label in labels:
        classes, numbers = np.unique(images.label(label)[rows], return_inverse=True)
        if len(classes) < 2:
            raise ValueError(f"label {label!r} has one value only ({classes[0]}) in {len(rows)} images")
        names[label] = tuple(map(str, classes))
        columns.append(torch.from_numpy(numbers.reshape(-1).astype(np.int64)))
    return names, torch.stack(columns, dim=1)


def accuracy(model: Resnet18, images: ImageSet) -> dict[str, float]:
    """By ``accuracy LABEL``: share of right answers where the label is known, 0 to 1; NaN if nowhere."""
    results = {}
    batches = map_batches(model.label_logits, model, images.images, batch_size=256)
    for (label, names), parts in zip(model.settings.classes.items(), zip(*batches, strict=True), strict=True):
        values = images.label(label)
        known = ~missing(values)
        best = np.array(names)[torch.cat(parts).argmax(dim=1).cpu().numpy()]
        right = best[known] == values[known].astype(str)
        results[f"accuracy {label}"] = float(right.mean()) if known.any() else float("nan")
    return results
