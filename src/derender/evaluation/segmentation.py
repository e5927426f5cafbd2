"""Face segmentation from pre-trained U-Net encoders: networks and controls on the same images, over seeds.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.7 and Table 3. A seed changes fresh weights (the decoder's
always) and the order of images, not the split. Each run is cached.

Scores: mean intersection over union, that of the ten best classes, and pixel accuracy. Pixels are counted
image by image and added up before they are divided. A class that no tested mask shows is left out of every
mean; answering it still costs the classes whose pixels it takes. Leaves out boundary scores.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from derender.data import read_masks
from derender.data.source import evenly_spaced
from derender.evaluation import bootstrap, segmenters
from derender.evaluation.memory import Memory, content_hash
from derender.evaluation.options import Options
from derender.evaluation.paper_tables import SEGMENTATION, beside_the_paper
from derender.evaluation.score_table import Column, Row, Scores, ScoreTable, scored_table, verdict_table
from derender.evaluation.segmenters import TEST_FRACTION, SegmentationData, SegmentSettings, divide
from derender.features import model_fingerprint
from derender.features.extract import check_size
from derender.inputs import as_model
from derender.storage.places import counted

SHOWN = 8
TOP = 10
COLUMNS = {  # all best at 1; top10_iou is higher by selection alone, background, skin and hair decide pixels
    "mean_iou": Column("mIoU", "high", note="intersection over union, mean over classes, 0 to 1"),
    "top10_iou": Column("top 10", "high", note="the same over the row's own ten best classes, 0 to 1"),
    "pixel_accuracy": Column("pixels", "high", note="share of right pixels, 0 to 1"),
}


@dataclass(frozen=True)
class SegmentationRow:
    """One network or control.

    ``class_iou`` is (C,), a mean over runs, NaN for classes that no tested mask shows. ``trainable`` counts
    weights; ``losses`` are (R, epochs). ``shown`` are the first run's answers for the comparison's images.
    """

    scored: bootstrap.ScoredRow
    class_iou: np.ndarray
    trainable: int
    losses: np.ndarray
    shown: np.ndarray


@dataclass(frozen=True)
class SegmentationComparison:
    """Networks in the order requested, then controls; ``shown`` are (K,) rows of the data for overlays."""

    rows: tuple[SegmentationRow, ...]
    data: SegmentationData
    seeds: tuple[int, ...]
    settings: SegmentSettings
    shown: np.ndarray

    @property
    def differs(self) -> str:
        """The difference between these data and the paper's, in words."""
        data, side = self.data, self.data.images.shape[-1]
        size = f"+ {len(data.test):,} images at {side} x {side}, {len(data.classes)} classes,"
        return SEGMENTATION.differs(data.layout, len(data.train), size)

    def numbers(self) -> dict[str, Any]:
        """Everything but images, for JSON."""
        data = self.data

        def by_class(values: np.ndarray) -> dict[str, float]:
            return dict(zip(data.classes, values.tolist(), strict=True))

        rows = bootstrap.numbers_of(row.scored for row in self.rows)
        for row in self.rows:
            more = {"trainable": row.trainable, "class_iou": by_class(row.class_iou)}
            rows[row.scored.name] |= {**more, "losses": row.losses.tolist()}
        return {
            "n_train": len(data.train), "n_test": len(data.test), "split": data.split, "seeds": self.seeds,
            "settings": self.settings.model_dump(), "train_share": by_class(data.shares(data.train)),
            "test_share": by_class(data.shares(data.test)), "rows": rows,
        }  # fmt: skip

    def tables(self) -> list[ScoreTable]:
        """Scores, verdicts, the IoU of every class, and the paper's rows."""
        data, scored = self.data, [row.scored for row in self.rows]
        share = data.shares(data.test)
        caption = (
            f"segmentation: {len(data.train):,} images learned, {len(data.test):,} tested (by {data.split}), "
            f"{(share > 0).sum()} of {len(data.classes)} classes tested, {self.settings.epochs} epochs, "
            f"{counted(len(self.seeds), 'seeds')}"
        )
        trainable = {row.scored.name: row.trainable or None for row in self.rows}
        more = {Column("learn", note="number of trained weights"): lambda row: trainable[row.name]}
        tables = [scored_table(caption, "net", scored, COLUMNS, more=more)]
        if any(row.versus for row in scored):
            tables.append(verdict_table(scored, COLUMNS, "above the strongest control?"))
        learning = [row for row in self.rows if row.trainable]
        columns = [Column(row.scored.name, None, note="IoU, 0 to 1") for row in learning]
        cells = np.column_stack([share, *(row.class_iou for row in learning)]).tolist()
        classes = [Row(data.classes[at], cells[at]) for at in np.argsort(-share, kind="stable").tolist()]
        heads = (Column("share", note="of the tested pixels"), *columns)
        tables.append(ScoreTable("intersection over union of every class", "class", heads, classes))
        plain: dict[str, Any] = {"intervals": (), "deviations": ()}
        ours = scored_table("segmentation, beside the paper's Table 3", "net", scored, COLUMNS, **plain)
        return [*tables, beside_the_paper(ours, tuple(COLUMNS), SEGMENTATION.paper, self.differs)]


def segment(
    model: Any, data: SegmentationData | str | Path, *, masks: str | Path | None = None,
    test_fraction: float = TEST_FRACTION, labelled: int | None = None, variants: Sequence[str] | None = None,
    seeds: Sequence[int] = (0, 1, 2), settings: SegmentSettings | None = None, **options: Any,
) -> Scores:  # fmt: skip
    """Do pre-trained U-Net encoders help segmentation? Variants trained once a seed beside controls.

    Args:
        model: with U-Net encoders (or the name or folder of one); stays as it was.
        data: divided images of the model's size with masks, or the path of a data set with masks.
        masks: folder or zip of masks named as the images, where the path has none.
        test_fraction, labelled: of a path, as in ``divide``.
        variants: names of ``VARIANTS``, the subject of the table first; by default all the model allows.
        seeds: of fresh weights and orders.
        settings: of the training.
        options: dataset, limit, device, resamples, cache, progress: fields of ``Options``; progress is called
            after every step with (images seen in all runs, images in all, the current run).

    Returns:
        The tables; ``result`` is the ``SegmentationComparison``.

    Raises:
        ValueError: the model has no U-Net encoders, or images of another size.
    """
    how = Options.of(options)
    model, report = as_model(model, device=how.device), how.progress or (lambda *_: None)
    chosen, notes = segmenters.chosen_variants(model, variants), []
    if not len(seeds):
        raise ValueError("a comparison needs at least one seed")
    if not isinstance(data, SegmentationData):
        read = read_masks(
            data, model.image_size, masks=masks, dataset=how.dataset, limit=how.limit,
            progress=lambda done, total: report(done, total, "reading"),
        )  # fmt: skip
        notes.append(read[0].describe())
        data = divide(*read, test_fraction=test_fraction, split_seed=seeds[0], labelled=labelled)
    check_size(model, data.images)
    settings = settings or SegmentSettings()
    settings = settings.model_copy(update={"batch_size": settings.batch_for(len(data.train))})
    shown = data.test[evenly_spaced(len(data.test), SHOWN)]
    content = content_hash({name: getattr(data, name) for name in ("images", "masks", "train", "test")})
    same = {"data": content, "classes": len(data.classes)}
    each = settings.epochs * len(data.train)
    total, done = each * len(chosen) * len(seeds), 0

    def counted(answers: np.ndarray) -> dict[str, np.ndarray]:
        counts = count_pixels(answers, data.masks[data.test], len(data.classes))
        return {"counts": counts.astype(np.int32), "shown": answers[np.searchsorted(data.test, shown)]}

    def trained(net: Any, seed: int, run: str) -> dict[str, np.ndarray]:
        def step(seen: int, loss: float) -> None:
            report(done + seen, total, f"{run}, seed {seed}, loss {loss:.2f}")

        losses = segmenters.train_segmenter(net, data, seed, settings, step)
        return {**counted(segmenters.answer(net, data.images[data.test])), "losses": np.array(losses)}

    weights = how.drawn(len(data.test))

    def row(title: str, control: bool, runs: list[dict[str, np.ndarray]], trainable: int) -> SegmentationRow:
        result = np.stack([resampled_scores(run["counts"], weights) for run in runs])
        iou = np.mean([class_iou(run["counts"]) for run in runs], axis=0)
        losses = np.array([run["losses"] for run in runs if trainable])
        scored = bootstrap.scored_row(title, control, COLUMNS, result)
        return SegmentationRow(scored, iou, trainable, losses, runs[0]["shown"])

    rows = []
    for name, variant in chosen.items():
        runs, trainable = [], 0
        for seed in seeds:
            net = segmenters.build_variant(model, variant, data, seed)
            trainable = sum(p.numel() for p in net.parameters() if p.requires_grad)
            inputs = {
                "start": model_fingerprint(net), "frozen": variant.frozen, "seed": seed, **same,
                "settings": settings.model_dump(mode="json"), "decoder": variant.decoder,
                "statistics": variant.frozen or variant.pretrained,
            }  # fmt: skip
            runs.append(how.memory.recall(f"segment-{name}", inputs, partial(trained, net, seed, name)))
            done += each
            report(done, total, name)
        rows.append(row(variant.title, not variant.pretrained, runs, trainable))
    apart = Memory(how.memory.folder)  # controls are cached as well, but are no runs
    for title, control in segmenters.CONTROLS.items():
        made = partial(lambda control: counted(control(data)), control)
        rows.append(row(title, True, [apart.recall("segment-control", {**same, "control": title}, made)], 0))
    judged = zip(rows, bootstrap.with_verdicts([row.scored for row in rows]), strict=True)
    compared = tuple(replace(row, scored=scored) for row, scored in judged)
    result = SegmentationComparison(compared, data, tuple(seeds), settings, shown)
    values = {"data": data.source, **result.numbers()}
    return Scores(result.tables(), values, [*notes, how.memory.summary("runs")], result=result)


def count_pixels(answers: np.ndarray, masks: np.ndarray, n_classes: int) -> np.ndarray:
    """(N, 3, C) int64: of each image and class, right pixels, answered pixels and pixels of the mask.

    ``answers`` and ``masks`` are (N, H, W) class numbers below ``n_classes``, C.
    """
    cell = n_classes * np.arange(len(masks))[:, None, None]
    kinds = ((cell + masks)[answers == masks], cell + answers, cell + masks)
    counts = [np.bincount(kind.ravel(), minlength=n_classes * len(masks)) for kind in kinds]
    return np.stack([count.reshape(len(masks), n_classes) for count in counts], axis=1)


def class_iou(counts: np.ndarray) -> np.ndarray:
    """(C,) IoU of each class over (N, 3, C) counts of N images; NaN for one that no mask shows."""
    return _iou(counts.sum(axis=0))


def resampled_scores(counts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The scores of ``COLUMNS``, (B, 3), of (N, 3, C) counts; ``weights`` (B, N) say how often each is drawn.

    The ten best classes are those of all images.
    """
    drawn = (weights.astype(np.float64) @ counts.reshape(len(counts), -1)).reshape(-1, *counts.shape[1:])
    iou = _iou(drawn)
    accuracy = drawn[:, 0].sum(axis=1) / drawn[:, 2].sum(axis=1)
    best = np.argsort(-class_iou(counts), kind="stable")[:TOP]  # NaN comes last
    means = (np.ma.masked_invalid(own).mean(axis=1).filled(0) for own in (iou, iou[:, best]))
    return np.column_stack((*means, accuracy))


def _iou(counts: np.ndarray) -> np.ndarray:
    """(..., C) intersection over union of (..., 3, C) counts; NaN for classes that are not there."""
    right, answered, there = np.moveaxis(counts.astype(np.float64), -2, 0)
    return np.divide(right, answered + there - right, out=np.full(right.shape, np.nan), where=there > 0)
