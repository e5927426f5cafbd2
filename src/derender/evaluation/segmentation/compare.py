"""All nets and controls on the same pictures: scores over seeds, intervals, who beats the controls.

Every net learns from the same pictures and is tested on the same others. A seed changes fresh weights (the
decoder's always) and the order of pictures, not the split. What a run found is remembered by the content of
what made it, so that an interrupted comparison goes on with the next run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from derender.evaluation.bootstrap import RESAMPLES, ScoredRow, estimate, resamples, with_verdicts
from derender.evaluation.memory import Memory, content_hash
from derender.evaluation.segmentation.controls import CONTROLS
from derender.evaluation.segmentation.pixels import SegmentationData
from derender.evaluation.segmentation.scores import (
    SCORES,
    count_pixels,
    resampled_scores,
    segmentation_scores,
)
from derender.evaluation.segmentation.train import SegmentSettings, answer, train_segmenter
from derender.evaluation.segmentation.variants import Variant, build_variant, check_encoders
from derender.features import model_fingerprint
from derender.networks.unet import LEVELS_KEPT, SegmentationNet

SHOWN = 8

Progress = Callable[[int, int, str], object]
"""Called with (pictures seen in all runs, pictures in all, what is running)."""


@dataclass(frozen=True)
class SegmentationRow:
    """One net or control.

    Attributes:
        scored: name, runs, ``SCORES`` with intervals and spread, and differences to the strongest control.
        class_iou: (C,) mean over runs; NaN for classes that no tested mask shows.
        trainable: weights that learned; 0 for controls without a net.
        losses: (R, epochs) mean training loss of each run.
        shown: (K, S, S) answers of the first run for the pictures in ``SegmentationComparison.shown``.
    """

    scored: ScoredRow
    class_iou: np.ndarray
    trainable: int
    losses: np.ndarray
    shown: np.ndarray


@dataclass(frozen=True)
class SegmentationComparison:
    """Nets side by side; the first row is what the table is about.

    Attributes:
        rows: nets in the order asked for, then controls.
        classes: their names.
        train_share, test_share: (C,) share of pixels of each class.
        n_train, n_test: pictures.
        split: how they were told apart.
        seeds: of the runs.
        settings: of the training.
        shown: (K,) rows of the data that pictures of results show.
    """

    rows: tuple[SegmentationRow, ...]
    classes: tuple[str, ...]
    train_share: np.ndarray
    test_share: np.ndarray
    n_train: int
    n_test: int
    split: str
    seeds: tuple[int, ...]
    settings: SegmentSettings
    shown: np.ndarray

    def numbers(self) -> dict[str, Any]:
        """Everything but pictures, as JSON takes it."""
        rows = {
            row.scored.name: {
                **row.scored.numbers(),
                "trainable": row.trainable,
                "class_iou": dict(zip(self.classes, row.class_iou.tolist(), strict=True)),
                "losses": row.losses.tolist(),
            }
            for row in self.rows
        }
        shares = {
            part: dict(zip(self.classes, getattr(self, part).tolist(), strict=True))
            for part in ("train_share", "test_share")
        }
        sizes = {name: getattr(self, name) for name in ("n_train", "n_test", "split", "seeds")}
        return {**sizes, "settings": self.settings.model_dump(), **shares, "rows": rows}


def compare_segmentations(
    model: Any,
    data: SegmentationData,
    variants: Mapping[str, Variant],
    seeds: Sequence[int],
    *,
    settings: SegmentSettings | None = None,
    resample_count: int = RESAMPLES,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> SegmentationComparison:
    """Train every variant once for each seed, and score it beside the controls.

    Args:
        model: with U-Net encoders; stays as it was.
        data: pictures of the model's size with masks, divided.
        variants: by name (``chosen_variants``).
        seeds: of fresh weights and orders.
        settings: of the training.
        resample_count: bootstrap resamples of the tested pictures.
        memory: where runs are kept.
        progress: told about every step.

    Raises:
        ValueError: the model has no U-Net encoders, or pictures of another size.
    """
    settings, memory = settings or SegmentSettings(), memory or Memory()
    settings = settings.model_copy(update={"batch_size": settings.batch_for(len(data.train))})
    check_encoders(model, variants)
    side = data.images.shape[-1]
    if side != model.image_size:
        raise ValueError(
            f"the pictures are {side} pixels wide, the model takes {model.image_size}: "
            f"read them with read_masks(..., {model.image_size})"
        )
    if not len(seeds):
        raise ValueError("a comparison needs at least one seed")
    shown = data.test[np.linspace(0, len(data.test) - 1, min(SHOWN, len(data.test))).astype(int)]
    content = content_hash({name: getattr(data, name) for name in ("images", "masks", "train", "test")})
    weights = np.concatenate(list(resamples(len(data.test), resample_count)))
    each = settings.epochs * len(data.train)
    total, done, rows = each * len(variants) * len(seeds), 0, []
    for name, variant in variants.items():
        runs, trainable = [], 0
        for seed in seeds:
            net = build_variant(model, variant, data, seed)
            trainable = sum(p.numel() for p in net.parameters() if p.requires_grad)
            inputs = {
                "start": model_fingerprint(net), "frozen": variant.frozen, "data": content, "seed": seed,
                "settings": settings.model_dump(mode="json"), "classes": len(data.classes),
                **_statistics(net),
            }  # fmt: skip

            def make(
                net: Any = net, seed: int = seed, before: int = done, note: str = f"{name}, seed {seed}"
            ):
                def step(seen: int, loss: float) -> None:
                    if progress is not None:
                        progress(before + seen, total, f"{note}, loss {loss:.2f}")

                losses = train_segmenter(net, data, seed, settings, step)
                return {
                    **_judged(answer(net, data.images[data.test]), data, shown),
                    "losses": np.array(losses),
                }

            runs.append(memory.recall(f"segment-{name}", inputs, make))
            done += each
            if progress is not None:
                progress(done, total, name)
        rows.append((variant.title, not variant.pretrained, runs, trainable))
    apart = Memory(memory.folder)  # controls are kept as well, but are no runs
    for title, control in CONTROLS.items():
        drawn, runs = seeds if title == "pixel colour" else seeds[:1], []
        for seed in drawn:
            inputs = {"data": content, "seed": seed, "classes": len(data.classes), "control": title}
            made = partial(_judged_control, control, data, seed, shown)
            runs.append(apart.recall("segment-control", inputs, made))
        rows.append((title, True, runs, 0))
    scored = with_verdicts([_scored(title, control, runs, weights) for title, control, runs, _ in rows])
    return SegmentationComparison(
        tuple(_row(one, runs, trainable) for one, (_, _, runs, trainable) in zip(scored, rows, strict=True)),
        data.classes,
        data.shares(data.train),
        data.shares(data.test),
        len(data.train),
        len(data.test),
        data.split,
        tuple(seeds),
        settings,
        shown,
    )


def _statistics(net: SegmentationNet) -> dict[str, Any]:
    """How the net's BatchNorm differs from that of fresh parts, for the name of a finished run."""
    if not net.fresh_decoder:
        return {"decoder": "learnt", "levels kept": LEVELS_KEPT}
    return {"statistics": "kept"} if net.kept_statistics and not net.frozen else {}


def _judged(answers: np.ndarray, data: SegmentationData, shown: np.ndarray) -> dict[str, np.ndarray]:
    """What is kept of a run's answers for the tested pictures."""
    counts = count_pixels(answers, data.masks[data.test], len(data.classes))
    return {"counts": counts.astype(np.int32), "shown": answers[np.searchsorted(data.test, shown)]}


def _judged_control(
    control: Callable[..., np.ndarray], data: SegmentationData, seed: int, shown: np.ndarray
) -> dict[str, np.ndarray]:
    return _judged(control(data, seed), data, shown)


def _scored(
    title: str, control: bool, runs: Sequence[Mapping[str, np.ndarray]], weights: np.ndarray
) -> ScoredRow:
    found = [segmentation_scores(run["counts"]) for run in runs]
    resampled = np.mean([resampled_scores(run["counts"], weights) for run in runs], axis=0)
    scores = {
        score: estimate([getattr(one, score) for one in found], resampled[:, at])
        for at, score in enumerate(SCORES)
    }
    return ScoredRow(title, control, len(runs), scores)


def _row(scored: ScoredRow, runs: Sequence[Mapping[str, np.ndarray]], trainable: int) -> SegmentationRow:
    iou = np.mean([segmentation_scores(run["counts"]).class_iou for run in runs], axis=0)
    losses = np.array([run["losses"] for run in runs if "losses" in run])
    return SegmentationRow(scored, iou, trainable, losses, runs[0]["shown"])
