"""The disentanglement card: every score of this package for a model and its controls, over several seeds.

Controls: the same networks untrained, with fresh weights for each seed. The model's own features with the
rows of each factor shuffled, which gives chance. Random pixel values, and whitened principal components,
split into as many blocks as there are features. The swap test needs a decoder, so only the model and the
untrained one have it. Without true factors among the labels that part is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from derender.baselines.controls import pca_features, untrained_twin
from derender.data import ImageSet
from derender.evaluation.bootstrap import LEVEL
from derender.evaluation.disentanglement import ground_truth
from derender.evaluation.disentanglement.similarity import (
    PearsonScores,
    SimilarityScores,
    correlation_matrix,
    pearson,
    similarity,
)
from derender.evaluation.disentanglement.swap import SwapScores, swap_test
from derender.evaluation.options import Options
from derender.evaluation.score_table import Column, Interval, Row, Scores, ScoreTable, interval_column
from derender.features import embed_images, model_fingerprint
from derender.features.table import check_finite
from derender.inputs import as_images, as_model
from derender.storage.places import counted

MODEL = "model"
MIN_IMAGES = 20
ENDS = ("ratio_95", "ratio_parameters_95")  # of the swap ratio, of features and of decoded parameters

_SWAP = Column("swap", "high", 2, "move of the exchanged feature over the others'; chance 1")
_DECODED = Column("decoded", "high", 2, "the same of decoded depth, albedo, light and camera")
_MIG = Column("MIG", "high", note="mutual information gap")
_SUMMARY = {  # by attribute of ``FeatureScores``
    "pearson.mean_per_image": Column("PCC image", note="Pearson of two vectors of an image, -1..1, best 0"),
    "pearson.mean_per_dimension": Column("PCC dim", note="mean |Pearson| of dimensions over images, best 0"),
    "similarity.mean_cka_unbiased": Column("CKA", note="linear, unbiased; 0 if independent, 1 if equal"),
    "similarity.mean_cross_r2": Column("cross R2", note="held-out variance explained by another; best 0"),
    "swap.ratio": _SWAP,
    ENDS[0]: interval_column(_SWAP, "images"),
    "swap.ratio_parameters": _DECODED,
    ENDS[1]: interval_column(_DECODED, "images"),
}
_WHOLE = {
    "truth.by_feature.disentanglement": Column("D", note="a feature holds one factor, best 1"),
    "truth.by_feature.completeness": Column("C", note="one feature holds a factor, best 1"),
    "truth.by_feature.informativeness": Column("I", "high", note="how well all features predict"),
    "truth.by_feature.mig": _MIG,
    "truth.by_feature.sap": Column("SAP", "high", note="gap of predictive score"),
    "truth.placed": Column("placed", "high", 2, "share of factors predicted best by their own feature"),
}
_DIMENSIONS = {
    "truth.by_dimension.disentanglement": Column("D", note="a dimension holds one factor"),
    "truth.by_dimension.completeness": Column("C", note="one dimension holds a factor"),
    "truth.by_dimension.mig": _MIG,
    "truth.by_dimension.sap": Column("SAP", "high", note="gap of squared correlation"),
}


@dataclass(frozen=True)
class FeatureScores:
    """All scores of features, one seed; ``truth`` is None without true factors, ``swap`` without decoder."""

    pearson: PearsonScores
    similarity: SimilarityScores
    truth: ground_truth.GroundTruthScores | None
    swap: SwapScores | None

    def get(self, path: str) -> Any:
        """A number or matrix by its path, such as ``swap.ratio``; None where a part is missing."""
        value: Any = self
        for name in path.split("."):
            value = None if value is None else getattr(value, name)
        return value


@dataclass(frozen=True)
class DisentanglementCard:
    """A model of some named ``features`` beside its controls, on ``n_pictures`` images.

    ``rows`` has one result per seed of the model and each control: seeds change folds and controls; the swap
    test's images and donors are the same. ``correlations`` is (sum of D, sum of D), |correlation| between all
    dimensions; ``dimensions`` are the lengths of the features.
    """

    features: tuple[str, ...]
    rows: Mapping[str, Sequence[FeatureScores]]
    correlations: np.ndarray
    dimensions: tuple[int, ...]
    n_pictures: int

    def mean(self, path: str, row: str = MODEL) -> Any:
        """Mean over seeds of a score or matrix by its path in ``FeatureScores``; None if it is missing."""
        results = [scores.get(path) for scores in self.rows[row]]
        return None if results[0] is None else np.mean(results, axis=0)

    def numbers(self) -> dict[str, Any]:
        """Every score of every row and seed for JSON; no matrix of all dimensions, no resamples."""

        def plain(scores: FeatureScores) -> dict[str, Any]:
            if scores.swap is None:
                return vars(scores)
            swap = {name: value for name, value in vars(scores.swap).items() if name != "resampled"}
            return {**vars(scores), "swap": swap | swap_intervals([scores.swap])}

        return {name: list(map(plain, results)) for name, results in self.rows.items()}

    def tables(self) -> list[ScoreTable]:
        """The summary, the swap test's matrices, and where true factors are known the scores against them."""
        truth, seeds = self.rows[MODEL][0].truth, counted(len(self.rows[MODEL]), "seeds")
        what = f"{', '.join(self.features)} of {self.n_pictures:,} images, mean over {seeds} of all pairs"
        caption = f"Disentanglement: {what}; low correlation alone proves nothing, read it with the swap test"
        results = [self._means(caption, _SUMMARY), *self._swap_tables()]
        if truth is None:
            return results
        caption = f"Whole features against {len(truth.factors)} true factors, best 1, mean over {seeds}"
        results.append(self._means(f"{caption}; where I is near 0, D and C are accidents", _WHOLE))
        if truth.by_dimension is not None:
            results.append(self._means(f"Single dimensions, as published, mean over {seeds}", _DIMENSIONS))
        together = {name: f"all, {name.split()[0]}" for name in self.rows} | {MODEL: "all"}
        all_of_them = (self.mean("truth.together", name) for name in together)
        cells = [*self.mean("truth.score"), *all_of_them, truth.chance]
        caption = "True factors from features, held out: R2 of light and camera, accuracy of classes; best 1"
        columns = [Column(head, None, 2) for head in (*self.features, *together.values(), "chance")]
        rows = [Row(*row) for row in zip(truth.factors, np.stack(cells, axis=1).tolist(), strict=True)]
        return [*results, ScoreTable(caption, "true factor", columns, rows)]

    def _means(self, caption: str, columns: Mapping[str, Column]) -> ScoreTable:
        """A row of means for each set of features; with several seeds, standard deviations below."""
        rows = []
        for name, results in self.rows.items():
            ends = swap_intervals([one.swap for one in results if one.swap is not None])
            means, deviations = [], []
            for path in columns:
                values = [] if path in ENDS else [v for one in results if (v := one.get(path)) is not None]
                means.append(ends.get(path, float(np.mean(values)) if values else None))
                deviations.append(f"{np.std(values, ddof=1):.3f}" if len(values) > 1 else None)
            rows.append(Row(name, means, name != MODEL))
            if len(results) > 1:
                rows.append(Row(f"  ± {len(results)} seeds", deviations, True))
        return ScoreTable(caption, "features", list(columns.values()), rows)

    def _swap_tables(self) -> list[ScoreTable]:
        """How far features, and decoded parameters, moved when one factor was exchanged."""
        if self.mean("swap.moved") is None:
            return []
        columns = [Column(name, None, 2) for name in self.features]
        left = "remaining distance from the exchanged feature to the donor's, best 0"
        ends = Column("picture", None, 2, "move of the pixels"), Column("left", None, 2, left)
        cells = np.column_stack([self.mean(f"swap.{name}") for name in ("moved", "moved_pixels", "arrived")])
        rows = list(map(Row, self.features, cells.tolist()))
        loss = [*self.mean("swap.unexchanged").tolist(), None, None]
        rows.append(Row("nothing", loss, True, "from an image to its own rendering"))
        best = "best 1 for the one exchanged, 0 elsewhere"
        caption = f"Swap test, features: 1 is the distance of two images; {best}"
        moved = list(map(Row, self.features, self.mean("swap.moved_parameters").tolist()))
        decoded = ScoreTable("Swap test, decoded parameters", "exchanged", columns, moved)
        return [ScoreTable(caption, "exchanged", [*columns, *ends], rows), decoded]


def disentangle(
    model: Any, images: ImageSet | str | Path, *, seeds: Sequence[int] = (0, 1, 2),
    dimensions: str | None = "lasso", swap_images: int = 256, batch_size: int = 128, **options: Any,
) -> Scores:  # fmt: skip
    """Does each feature hold its own factor? Correlation, CKA, the swap test; on rendered data DCI, MIG, SAP.

    Args:
        model: a ``Derenderer``, or the name or folder of one.
        images: an image set at the model's size, or the path of a data set; 20 images or more. Labels that
            are factors of a rendered scene (``true_factors``) bring the scores against ground truth.
        seeds: one result each.
        dimensions: importances of the scores by dimension, "lasso"; None leaves these scores out.
        swap_images: at most so many images, drawn with the first seed, go through the swap test.
        batch_size: images at a time; changes speed and memory only.
        options: limit, device, cache, progress: fields of ``Options``.

    Returns:
        The tables; ``result`` is the ``DisentanglementCard``.
    """
    how = Options.of(options)
    model, kept = as_model(model, device=how.device), how.memory
    images = as_images(images, model.image_size, dataset=how.dataset, limit=how.limit)
    images.require(MIN_IMAGES, "the disentanglement card")
    if not seeds:
        raise ValueError("the card needs at least one seed")
    pixels, (factors, unused) = images.images, ground_truth.true_factors(images.labels)
    facts = {"weights": model_fingerprint(model), "settings": model.settings.model_dump(mode="json")}
    inputs = {**facts, "images": pixels, **{f"factor {factor.name}": factor.values for factor in factors}}

    @cache
    def features() -> dict[str, np.ndarray]:
        result = embed_images(model, pixels, batch_size=batch_size)
        check_finite(result, images.files)
        return result

    sizes = {name: values.shape[1] for name, values in embed_images(model, pixels[:1]).items()}
    correlations = kept.recall_one("card-correlation", inputs, lambda: correlation_matrix(features()))

    components = max(len(sizes), min(64, len(images) // 4))
    whitened = cache(partial(pca_features, images, components=components))
    drawn = np.sort(np.random.default_rng(seeds[0]).permutation(len(pixels))[:swap_images])

    def swapped(net: Any, blocks: Mapping[str, np.ndarray]) -> SwapScores:
        known = {name: values[drawn] for name, values in blocks.items()}
        return swap_test(net, pixels[drawn], seed=seeds[0], batch_size=batch_size, known=known)

    own_swap = cache(lambda: swapped(model, features()))

    def made(row: str, seed: int) -> FeatureScores:
        swap, truth = None, None
        if row == MODEL:
            blocks, swap = features(), own_swap()
        elif row == "untrained encoder":
            net = untrained_twin(model, seed)
            blocks = embed_images(net, pixels, batch_size=batch_size)
            swap = swapped(net, blocks)
        elif row == "random pixels":
            chosen = dealt(pixels.reshape(len(pixels), -1), list(sizes.values()), seed)
            blocks = {name: part.astype(np.float32) / 255 for name, part in zip(sizes, chosen, strict=True)}
        elif row == "PCA":
            values = whitened().concatenate()
            equal = [len(part) for part in np.array_split(values[0], len(sizes))]
            blocks = dict(zip(sizes, dealt(values, equal, seed), strict=True))
        else:
            blocks = shuffled_rows(features(), seed)
        if len(factors) >= 2:
            truth = ground_truth.ground_truth_scores(blocks, factors, dimensions=dimensions, seed=seed)
        return FeatureScores(pearson(blocks), similarity(blocks, seed=seed), truth, swap)

    names = (MODEL, "untrained encoder", "shuffled rows", "random pixels", "PCA")
    rows: dict[str, list[FeatureScores]] = {name: [] for name in names}
    for seed in seeds:
        for name, result in rows.items():
            keys = {"row": name, "seed": seed, "dimensions": dimensions, "swap": [swap_images, seeds[0]]}
            make = partial(made, name, seed)
            result.append(kept.recall_value("card", {**inputs, **keys}, FeatureScores, make))
            if how.progress is not None:
                how.progress(sum(map(len, rows.values())), len(seeds) * len(rows))
    card = DisentanglementCard(tuple(sizes), rows, correlations, tuple(sizes.values()), len(images))
    tables, places = card.tables(), list(_SUMMARY.values())
    notes = [f"swap test: {tables[0].verdict(places.index(_SWAP))}"]
    notes += [f"swap test, decoded: {tables[0].verdict(places.index(_DECODED))}"]
    notes += [f"left out of the true factors: {name} ({why})" for name, why in unused.items()]
    values = {"pictures": len(images), "features": sizes, "seeds": list(seeds), "left_out": unused}
    return Scores(tables, {**values, "rows": card.numbers()}, [*notes, kept.summary()], result=card)


def swap_intervals(tests: Sequence[SwapScores]) -> dict[str, Interval]:
    """95 % intervals of mean ratios over seeds, by ``ENDS``; NaN where a ratio is NaN or infinite."""
    if not tests:
        return {}
    drawn = np.mean([test.resampled for test in tests], axis=0)
    ends = np.full((2, 2), np.nan)
    if len(drawn) and np.isfinite(drawn).all():
        ends = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return {name: Interval(*own) for name, own in zip(ENDS, ends.T.tolist(), strict=True)}


def shuffled_rows(features: Mapping[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
    """Features whose rows are shuffled by another permutation for each factor: no two of them correspond."""
    generator = np.random.default_rng(seed)
    return {name: values[generator.permutation(len(values))] for name, values in features.items()}


def dealt(values: np.ndarray, sizes: Sequence[int], seed: int) -> list[np.ndarray]:
    """For each size, that many random columns of (N, D) values, none of them twice.

    Blocks shrink in proportion where there are fewer columns than requested.
    """
    share = min(1.0, values.shape[1] / sum(sizes))
    ends = np.cumsum([max(1, int(size * share)) for size in sizes])
    chosen = np.random.default_rng(seed).permutation(values.shape[1])[: ends[-1]]
    return [values[:, columns] for columns in np.split(chosen, ends[:-1])]
