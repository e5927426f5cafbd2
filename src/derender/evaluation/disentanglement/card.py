"""The disentanglement card: every score of this folder for one model beside its controls, over several seeds.

Controls: the same networks untrained (fresh weights for each seed); the model's own features with the rows of
each factor shuffled by themselves, which is what chance gives; and random pixel values, and whitened
principal components, dealt into as many blocks as there are features, which no encoder has seen. The swap
test needs a decoder, so the model and the untrained one have it alone. Without true factors among the labels
that part is left out. A majority's answer has no features; it is the chance of every class.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np

from derender.baselines.controls import pca_features, untrained_twin
from derender.data import PictureSet
from derender.evaluation.bootstrap import LEVEL
from derender.evaluation.disentanglement.ground_truth_scores import GroundTruthScores, ground_truth_scores
from derender.evaluation.disentanglement.pearson import PearsonScores, correlation_matrix, pearson
from derender.evaluation.disentanglement.similarity import SimilarityScores, similarity
from derender.evaluation.disentanglement.swap import SwapScores, swap_test
from derender.evaluation.disentanglement.true_factors import TrueFactor, true_factors
from derender.evaluation.memory import Memory
from derender.evaluation.memory_values import recall_value
from derender.features import embed_images, model_fingerprint
from derender.features.table import check_finite

MODEL, UNTRAINED, SHUFFLED, PIXELS = "model", "untrained encoder", "shuffled rows", "random pixels"
COMPONENTS = "PCA"
MIN_PICTURES = 20


@dataclass(frozen=True)
class FeatureScores:
    """Everything that is known about one set of features, with one seed.

    Attributes:
        pearson, similarity: between features.
        truth: against the true factors; None where the labels hold none.
        swap: the swap test; None for features without a decoder.
    """

    pearson: PearsonScores
    similarity: SimilarityScores
    truth: GroundTruthScores | None
    swap: SwapScores | None


@dataclass(frozen=True)
class DisentanglementCard:
    """A model beside its controls.

    Attributes:
        features: names of the model's features, in the order of every matrix.
        rows: for the model and each control, one result per seed. Seeds change the folds of the predictions,
            the donors and pictures of the swap test, and what a control draws; the model stays the same.
        correlations: (sum of D, sum of D) |correlation| between all dimensions of the model's features.
        dimensions: length of each feature.
        n_pictures: how many pictures.
    """

    features: tuple[str, ...]
    rows: Mapping[str, Sequence[FeatureScores]]
    correlations: np.ndarray
    dimensions: tuple[int, ...]
    n_pictures: int

    def numbers(self) -> dict[str, Any]:
        """Every score of every row and seed as JSON takes it; no matrix of all dimensions, no resamples."""

        def told(scores: FeatureScores) -> dict[str, Any]:
            parts = {field.name: getattr(scores, field.name) for field in fields(scores)}
            swap = scores.swap
            if swap is not None:
                shown = {field.name: getattr(swap, field.name) for field in fields(swap)}
                del shown["resampled"]
                ends = swap_interval([swap])
                parts["swap"] = {**shown, "ratio_95": ends[0], "ratio_parameters_95": ends[1]}
            return parts

        return {name: [told(scores) for scores in results] for name, results in self.rows.items()}


def evaluate_disentanglement(
    model: Any,
    pictures: PictureSet,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    dimensions: str | None = "lasso",
    swap_pictures: int = 256,
    batch_size: int = 64,
    memory: Memory | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> DisentanglementCard:
    """Fill the card.

    Args:
        model: a ``Derenderer``.
        pictures: read at the model's image size, 20 or more; labels that are factors of a rendered scene
            (``true_factors``) bring the scores against ground truth.
        seeds: one result each.
        dimensions: how the scores by dimension weigh dimensions ("lasso", or "trees", which takes minutes);
            None leaves them out.
        swap_pictures: at most so many pictures, drawn anew for each seed, go through the swap test.
        batch_size: pictures at a time; changes speed and memory only.
        memory: where the scores of each row and seed are kept.
        progress: called with (steps done, steps in all).
    """
    count = pictures.require(MIN_PICTURES, "the disentanglement card").images.shape[0]
    if not seeds:
        raise ValueError("the card needs at least one seed")
    factors = true_factors(pictures.labels)
    kept = memory or Memory()
    inputs = _inputs(model, pictures, factors) if kept.folder is not None else {}

    @cache
    def features() -> dict[str, np.ndarray]:
        found = embed_images(model, pictures.images, batch_size=batch_size)
        check_finite(found, pictures.files)
        return found

    @cache
    def fresh(seed: int) -> tuple[Any, dict[str, np.ndarray]]:
        twin = untrained_twin(model, seed)
        return twin, embed_images(twin, pictures.images, batch_size=batch_size)

    @cache
    def components() -> np.ndarray:
        wanted = max(len(sizes), min(64, count // 4))
        return pca_features(pictures, components=wanted).concatenate()

    def whole() -> dict[str, np.ndarray]:
        lengths = np.array([values.shape[1] for values in features().values()])
        return {
            "names": np.array(list(features())),
            "sizes": lengths,
            "correlations": correlation_matrix(features()),
        }

    found = kept.recall("card-correlations", inputs, whole)
    sizes = dict(zip(found["names"].tolist(), found["sizes"].tolist(), strict=True))
    rows: dict[str, list[FeatureScores]] = {
        name: [] for name in (MODEL, UNTRAINED, SHUFFLED, PIXELS, COMPONENTS)
    }
    done, total = 0, len(seeds) * len(rows)

    def scored(blocks: Mapping[str, np.ndarray], seed: int, net: Any = None) -> FeatureScores:
        swap = None
        if net is not None:
            chosen = np.sort(np.random.default_rng(seed).permutation(count)[:swap_pictures])
            swap = swap_test(net, pictures.images[chosen], seed=seed, batch_size=batch_size)
        truth = None
        if len(factors) >= 2:
            truth = ground_truth_scores(blocks, factors, dimensions=dimensions, seed=seed)
        return FeatureScores(pearson(blocks), similarity(blocks, seed=seed), truth, swap)

    made: dict[str, Callable[[int], FeatureScores]] = {
        MODEL: lambda seed: scored(features(), seed, model),
        UNTRAINED: lambda seed: scored(fresh(seed)[1], seed, fresh(seed)[0]),
        SHUFFLED: lambda seed: scored(shuffled_rows(features(), seed), seed),
        PIXELS: lambda seed: scored(random_pixels(pictures.images, sizes, seed), seed),
        COMPONENTS: lambda seed: scored(dealt(components(), list(sizes), seed), seed),
    }
    for seed in seeds:
        for name, make in made.items():
            how = {"row": name, "seed": seed, "dimensions": dimensions, "swap_pictures": swap_pictures}
            one = recall_value(
                kept, "card", {**inputs, **how}, FeatureScores, lambda make=make, seed=seed: make(seed)
            )
            rows[name].append(one)
            done += 1
            if progress is not None:
                progress(done, total)
        fresh.cache_clear()
    return DisentanglementCard(tuple(sizes), rows, found["correlations"], tuple(sizes.values()), count)


def swap_interval(tests: Sequence[SwapScores]) -> tuple[tuple[float, float], tuple[float, float]]:
    """The 95 % intervals of the mean over seeds of the swap test's ratio, of features and of decoded
    parameters; NaN where a ratio is not known."""
    drawn = np.mean([test.resampled for test in tests], axis=0)
    if not len(drawn) or not np.isfinite(drawn).all():
        return (np.nan, np.nan), (np.nan, np.nan)
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _inputs(model: Any, pictures: PictureSet, factors: Sequence[TrueFactor]) -> dict[str, Any]:
    """What decides the card, besides seeds and options."""
    return {
        "weights": model_fingerprint(model),
        "settings": model.settings.model_dump(mode="json"),
        "images": pictures.images,
        **{f"factor {factor.name}": factor.values for factor in factors},
    }


def shuffled_rows(features: Mapping[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
    """Features whose rows are dealt anew, by another permutation for each factor: nothing fits anything."""
    generator = np.random.default_rng(seed)
    return {name: values[generator.permutation(len(values))] for name, values in features.items()}


def random_pixels(images: np.ndarray, sizes: Mapping[str, int], seed: int) -> dict[str, np.ndarray]:
    """For each name, that many pixel values in 0..1 drawn without repetition from uint8 pictures (N, 3, H,
    W).

    Blocks grow smaller in proportion where the pictures have fewer values than are asked for.
    """
    flat = images.reshape(len(images), -1)
    wanted = sum(sizes.values())
    share = min(1.0, flat.shape[1] / wanted)
    chosen = np.random.default_rng(seed).permutation(flat.shape[1])
    blocks, start = {}, 0
    for name, size in sizes.items():
        taken = chosen[start : start + max(1, int(size * share))]
        blocks[name] = flat[:, taken].astype(np.float32) / 255
        start += len(taken)
    return blocks


def dealt(components: np.ndarray, names: Sequence[str], seed: int) -> dict[str, np.ndarray]:
    """(N, D) principal components dealt at random into one block for each name, of D / names each."""
    chosen = np.array_split(np.random.default_rng(seed).permutation(components.shape[1]), len(names))
    return {name: components[:, taken] for name, taken in zip(names, chosen, strict=True)}
