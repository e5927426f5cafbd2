"""The disentanglement card: every score of this package for a model and its controls, over several seeds.

Controls: the same networks untrained (fresh weights for each seed); the model's own features with the rows of
each factor shuffled, which gives chance; and random pixel values, and whitened principal components, split
into as many blocks as there are features, which need no encoder. The swap test needs a decoder, so only the
model and the untrained one have it. Without true factors among the labels that part is left out. A majority's
answer has no features; it is the chance of every class.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from derender.baselines.controls import pca_features, untrained_twin
from derender.data import ImageSet
from derender.evaluation.bootstrap import LEVEL
from derender.evaluation.disentanglement.ground_truth import (
    GroundTruthScores,
    ground_truth_scores,
    left_out,
    true_factors,
)
from derender.evaluation.disentanglement.similarity import (
    PearsonScores,
    SimilarityScores,
    correlation_matrix,
    pearson,
    similarity,
)
from derender.evaluation.disentanglement.swap import SwapScores, swap_test
from derender.evaluation.memory import Memory
from derender.evaluation.score_table import Column, Interval, Row, Scores, ScoreTable, interval_column
from derender.features import embed_images, model_fingerprint
from derender.features.table import check_finite
from derender.inputs import as_images, as_model

MODEL, UNTRAINED, SHUFFLED, PIXELS = "model", "untrained encoder", "shuffled rows", "random pixels"
COMPONENTS = "PCA"
MIN_IMAGES = 20

_SWAP = Column("swap", "high", 2, "move of the exchanged feature over the others'; chance 1")
_DECODED = Column("decoded", "high", 2, "the same of decoded depth, albedo, light and camera")
_SUMMARY = {  # by attribute of ``FeatureScores``
    "pearson.mean_per_image": Column(
        "PCC image", note="Pearson between two vectors of an image, -1 to 1, best 0"
    ),
    "pearson.mean_per_dimension": Column(
        "PCC dim", note="mean |Pearson| of dimensions over images, 0 to 1, best 0"
    ),
    "similarity.mean_cka_unbiased": Column(
        "CKA", note="linear, unbiased; about 0 for independent features, 1 for equal ones"
    ),
    "similarity.mean_cross_r2": Column(
        "cross R2", note="held-out variance of a feature explained by another; best 0"
    ),
    "swap.ratio": _SWAP,
    "swap.ratio_parameters": _DECODED,
}
_MIG = Column("MIG", "high", note="mutual information gap")
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
    "truth.grouped_dci.0": Column("D, grouped", note="importances added up by feature"),
    "truth.grouped_dci.1": Column("C, grouped", note="importances added up by feature"),
}


@dataclass(frozen=True)
class FeatureScores:
    """All scores of one set of features, with one seed.

    Attributes:
        pearson, similarity: between features.
        truth: against the true factors; None where the labels hold none.
        swap: the swap test; None for features without a decoder.
    """

    pearson: PearsonScores
    similarity: SimilarityScores
    truth: GroundTruthScores | None
    swap: SwapScores | None

    def get(self, path: str) -> Any:
        """A number or matrix by its path, such as ``swap.ratio``; None where a part is missing."""
        value: Any = self
        for name in path.split("."):
            if value is not None:
                value = value[int(name)] if name.isdigit() else getattr(value, name)
        return value


@dataclass(frozen=True)
class DisentanglementCard:
    """A model beside its controls.

    Attributes:
        features: names of the model's features, in the order of every matrix.
        rows: for the model and each control, one result per seed. Seeds change the folds of the predictions,
            the donors and images of the swap test, and the random controls; the model stays the same.
        correlations: (sum of D, sum of D) |correlation| between all dimensions of the model's features.
        dimensions: length of each feature.
        n_pictures: how many images.
    """

    features: tuple[str, ...]
    rows: Mapping[str, Sequence[FeatureScores]]
    correlations: np.ndarray
    dimensions: tuple[int, ...]
    n_pictures: int

    @property
    def model_scores(self) -> Sequence[FeatureScores]:
        """The model's own results, one per seed."""
        return next(iter(self.rows.values()))

    def numbers(self) -> dict[str, Any]:
        """Every score of every row and seed for JSON; no matrix of all dimensions, no resamples."""

        def plain(scores: FeatureScores) -> dict[str, Any]:
            parts = {field.name: getattr(scores, field.name) for field in fields(scores)}
            if scores.swap is not None:
                names = (field.name for field in fields(scores.swap) if field.name != "resampled")
                ends = dict(
                    zip(("ratio_95", "ratio_parameters_95"), swap_interval([scores.swap]), strict=True)
                )
                parts["swap"] = {**{name: getattr(scores.swap, name) for name in names}, **ends}
            return parts

        return {name: [plain(scores) for scores in results] for name, results in self.rows.items()}

    def tables(self) -> list[ScoreTable]:
        """The summary, the swap test's matrices, and where true factors are known the scores against them."""
        truth = self.model_scores[0].truth
        found = [self._summary(), *self._swap_tables()]
        if truth is None:
            return found
        caption = (
            f"Whole features against {len(truth.factors)} true factors, best 1, mean over {self._seeds}; "
            "where I is near 0, D and C are accidents"
        )
        found.append(self._means(caption, _WHOLE))
        if truth.by_dimension is not None:
            caption = f"Single dimensions, as published, mean over {self._seeds}"
            found.append(self._means(caption, _DIMENSIONS))
        return [*found, self._factor_table(truth)]

    @property
    def _seeds(self) -> str:
        count = len(self.model_scores)
        return "1 seed" if count == 1 else f"{count} seeds"

    def _means(self, caption: str, columns: Mapping[str, Column]) -> ScoreTable:
        """A row of means for each set of features; with several seeds, standard deviations below."""
        rows = []
        for name, results in self.rows.items():
            values = [
                [one for scores in results if (one := scores.get(path)) is not None] for path in columns
            ]
            means = [float(np.mean(column)) if column else None for column in values]
            rows.append(Row(name, means, name != MODEL))
            if len(results) > 1:
                deviations = [f"{np.std(v, ddof=1):.3f}" if len(v) > 1 else None for v in values]
                rows.append(Row(f"  ± {len(results)} seeds", deviations, True))
        return ScoreTable(caption, "features", list(columns.values()), rows)

    def _summary(self) -> ScoreTable:
        """Correlation, similarity and the swap test with its intervals, means over seeds."""
        caption = (
            f"Disentanglement: {', '.join(self.features)} of {self.n_pictures:,} images, mean over "
            f"{self._seeds} of all pairs; low correlation alone proves nothing, read it with the swap test"
        )
        table = self._means(caption, _SUMMARY)
        ends = [interval_column(column, "images") for column in (_SWAP, _DECODED)]
        rows = []
        for row in table.rows:
            tests = [scores.swap for scores in self.rows.get(row.name, ()) if scores.swap is not None]
            both = [Interval(*one) for one in swap_interval(tests)] if tests else [None, None]
            cells = [*row.cells[:5], both[0], row.cells[5], both[1]]
            rows.append(Row(row.name, cells, row.control))
        columns = [*table.columns[:5], ends[0], _DECODED, ends[1]]
        return ScoreTable(caption, table.first, columns, rows)

    def _swap_tables(self) -> list[ScoreTable]:
        """How far features, and decoded parameters, moved when one factor was exchanged."""
        tests = [scores.swap for scores in self.model_scores if scores.swap is not None]
        if not tests:
            return []

        def mean(name: str) -> np.ndarray:
            return np.mean([getattr(test, name) for test in tests], axis=0)

        columns = [Column(name, None, 2) for name in self.features]
        ends = (
            Column("picture", None, 2, "move of the pixels"),
            Column("left", None, 2, "remaining distance from the exchanged feature to the donor's, best 0"),
        )
        cells = np.column_stack((mean("moved"), mean("moved_pixels"), mean("arrived"))).tolist()
        rows = [Row(name, row) for name, row in zip(self.features, cells, strict=True)]
        loss = [*mean("unexchanged").tolist(), None, None]
        rows.append(Row("nothing", loss, True, "from an image to its own rendering"))
        caption = (
            "Swap test, features: 1 is the distance of two images; best 1 for the one exchanged, 0 elsewhere"
        )
        decoded = zip(self.features, mean("moved_parameters").tolist(), strict=True)
        return [
            ScoreTable(caption, "exchanged", [*columns, *ends], rows),
            ScoreTable("Swap test, decoded parameters", "exchanged", columns, [Row(*one) for one in decoded]),
        ]

    def _factor_table(self, truth: GroundTruthScores) -> ScoreTable:
        """A row for each true factor: how well each feature predicts it, all together, and the controls."""

        def mean(row: str, name: str) -> np.ndarray:
            return np.mean([getattr(one.truth, name) for one in self.rows[row]], axis=0)

        first, *controls = self.rows
        cells = [*mean(first, "score"), *(mean(name, "together") for name in self.rows), truth.chance]
        heads = [*self.features, "all", *(f"all, {name.split()[0]}" for name in controls), "chance"]
        rows = zip(truth.factors, np.stack(cells, axis=1).tolist(), strict=True)
        return ScoreTable(
            "True factors from features, held out: R2 of light and camera, accuracy of classes; best 1",
            "true factor",
            [Column(head, None, 2) for head in heads],
            [Row(*row) for row in rows],
        )


def disentangle(
    model: Any,
    images: ImageSet | str | Path,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    dimensions: str | None = "lasso",
    swap_images: int = 256,
    batch_size: int = 64,
    memory: Memory | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Scores:
    """Does each feature hold its own factor? Correlation, CKA, the swap test; on rendered data DCI, MIG, SAP.

    Args:
        model: a ``Derenderer``, or the name or folder of one.
        images: an image set at the model's size, or the path of a data set; 20 images or more. Labels that
            are factors of a rendered scene (``true_factors``) bring the scores against ground truth.
        seeds: one result each.
        dimensions: importances of the scores by dimension ("lasso", or "trees", which takes minutes); None
            leaves them out.
        swap_images: at most so many images, a random subset for each seed, go through the swap test.
        batch_size: images at a time; changes speed and memory only.
        memory: cache of the scores of each row and seed.
        progress: called with (steps done, steps in all).

    Returns:
        The tables; ``result`` is the ``DisentanglementCard``.
    """
    model = as_model(model)
    pictures = as_images(images, model.image_size)
    card = _card(model, pictures, seeds, dimensions, swap_images, batch_size, memory or Memory(), progress)
    tables, unused = card.tables(), left_out(pictures.labels)
    places = {column.name: place for place, column in enumerate(tables[0].columns)}
    names = {_SWAP.name: "swap test", _DECODED.name: "swap test, decoded"}
    notes = [f"{name}: {tables[0].verdict(places[column])}" for column, name in names.items()]
    notes += [f"left out of the true factors: {name} ({why})" for name, why in unused.items()]
    values = {
        "pictures": card.n_pictures,
        "features": dict(zip(card.features, card.dimensions, strict=True)),
        "seeds": list(seeds),
        "left_out": unused,
        "rows": card.numbers(),
    }
    return Scores(tables, values, notes, result=card)


def _card(
    model: Any,
    pictures: ImageSet,
    seeds: Sequence[int],
    dimensions: str | None,
    swap_images: int,
    batch_size: int,
    kept: Memory,
    progress: Callable[[int, int], object] | None,
) -> DisentanglementCard:
    count = pictures.require(MIN_IMAGES, "the disentanglement card").images.shape[0]
    if not seeds:
        raise ValueError("the card needs at least one seed")
    factors = true_factors(pictures.labels)
    inputs = {
        "weights": model_fingerprint(model),
        "settings": model.settings.model_dump(mode="json"),
        "images": pictures.images,
        **{f"factor {factor.name}": factor.values for factor in factors},
    }

    @cache
    def features() -> dict[str, np.ndarray]:
        found = embed_images(model, pictures.images, batch_size=batch_size)
        check_finite(found, pictures.files)
        return found

    @cache
    def components() -> np.ndarray:
        return pca_features(pictures, components=max(len(sizes), min(64, count // 4))).concatenate()

    def whole() -> dict[str, np.ndarray]:
        lengths = np.array([values.shape[1] for values in features().values()])
        names = np.array(list(features()))
        return {"names": names, "sizes": lengths, "correlations": correlation_matrix(features())}

    found = kept.recall("card-correlations", inputs, whole)
    sizes = dict(zip(found["names"].tolist(), found["sizes"].tolist(), strict=True))

    def scored(blocks: Mapping[str, np.ndarray], seed: int, net: Any = None) -> FeatureScores:
        swap, truth = None, None
        if net is not None:
            chosen = np.sort(np.random.default_rng(seed).permutation(count)[:swap_images])
            swap = swap_test(net, pictures.images[chosen], seed=seed, batch_size=batch_size)
        if len(factors) >= 2:
            truth = ground_truth_scores(blocks, factors, dimensions=dimensions, seed=seed)
        return FeatureScores(pearson(blocks), similarity(blocks, seed=seed), truth, swap)

    def untrained(seed: int) -> FeatureScores:
        twin = untrained_twin(model, seed)
        return scored(embed_images(twin, pictures.images, batch_size=batch_size), seed, twin)

    made: dict[str, Callable[[int], FeatureScores]] = {
        MODEL: lambda seed: scored(features(), seed, model),
        UNTRAINED: untrained,
        SHUFFLED: lambda seed: scored(shuffled_rows(features(), seed), seed),
        PIXELS: lambda seed: scored(random_pixels(pictures.images, sizes, seed), seed),
        COMPONENTS: lambda seed: scored(random_blocks(components(), list(sizes), seed), seed),
    }
    rows: dict[str, list[FeatureScores]] = {name: [] for name in made}
    for seed in seeds:
        for name, make in made.items():
            keys = {"row": name, "seed": seed, "dimensions": dimensions, "swap_pictures": swap_images}
            one = kept.recall_value(
                "card", {**inputs, **keys}, FeatureScores, lambda make=make, seed=seed: make(seed)
            )
            rows[name].append(one)
            if progress is not None:
                progress(sum(map(len, rows.values())), len(seeds) * len(rows))
    return DisentanglementCard(tuple(sizes), rows, found["correlations"], tuple(sizes.values()), count)


def swap_interval(tests: Sequence[SwapScores]) -> tuple[tuple[float, float], tuple[float, float]]:
    """The 95 % intervals of the mean over seeds of the swap test's ratio, of features and of decoded
    parameters; NaN where a ratio is NaN or infinite."""
    resampled = np.mean([test.resampled for test in tests], axis=0)
    if not len(resampled) or not np.isfinite(resampled).all():
        return (np.nan, np.nan), (np.nan, np.nan)
    low, high = np.quantile(resampled, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def shuffled_rows(features: Mapping[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
    """Features whose rows are shuffled by another permutation for each factor: no two of them correspond."""
    generator = np.random.default_rng(seed)
    return {name: values[generator.permutation(len(values))] for name, values in features.items()}


def random_pixels(images: np.ndarray, sizes: Mapping[str, int], seed: int) -> dict[str, np.ndarray]:
    """For each name, that many pixel values in 0..1 of uint8 images (N, 3, H, W), none of them twice.

    Blocks shrink in proportion where the images have fewer values than requested.
    """
    flat = images.reshape(len(images), -1)
    share = min(1.0, flat.shape[1] / sum(sizes.values()))
    ends = np.cumsum([max(1, int(size * share)) for size in sizes.values()])
    chosen = np.split(np.random.default_rng(seed).permutation(flat.shape[1])[: ends[-1]], ends[:-1])
    return {
        name: flat[:, pixels].astype(np.float32) / 255 for name, pixels in zip(sizes, chosen, strict=True)
    }


def random_blocks(components: np.ndarray, names: Sequence[str], seed: int) -> dict[str, np.ndarray]:
    """(N, D) principal components split at random into one block for each name, of D / names each."""
    chosen = np.array_split(np.random.default_rng(seed).permutation(components.shape[1]), len(names))
    return {name: components[:, columns] for name, columns in zip(names, chosen, strict=True)}
