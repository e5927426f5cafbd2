"""The disentanglement card: every score of this folder for one model beside its controls, over several seeds.

Controls: the same networks untrained (fresh weights for each seed); the model's own features with the rows of
each factor shuffled by themselves, which is what chance gives; and random pixel values dealt into as many
blocks as there are features, which no encoder has seen. The swap test needs a decoder, so the model and the
untrained one have it alone. Without true factors among the labels that part is left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.baselines.controls import untrained_twin
from derender.data import PictureSet
from derender.evaluation.disentanglement.ground_truth_scores import GroundTruthScores, ground_truth_scores
from derender.evaluation.disentanglement.pearson import PearsonScores, correlation_matrix, pearson
from derender.evaluation.disentanglement.similarity import SimilarityScores, similarity
from derender.evaluation.disentanglement.swap import SwapScores, swap_test
from derender.evaluation.disentanglement.true_factors import true_factors
from derender.features import embed_images

MODEL, UNTRAINED, SHUFFLED, PIXELS = "model", "untrained encoder", "shuffled rows", "random pixels"
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


def evaluate_disentanglement(
    model: Any,
    pictures: PictureSet,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    dimensions: str | None = "lasso",
    swap_pictures: int = 256,
    batch_size: int = 64,
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
        progress: called with (steps done, steps in all).
    """
    count = pictures.require(MIN_PICTURES, "the disentanglement card").images.shape[0]
    if not seeds:
        raise ValueError("the card needs at least one seed")
    features = embed_images(model, pictures.images, batch_size=batch_size)
    factors = true_factors(pictures.labels)
    rows: dict[str, list[FeatureScores]] = {name: [] for name in (MODEL, UNTRAINED, SHUFFLED, PIXELS)}
    done, total = 0, len(seeds) * len(rows)

    def add(name: str, blocks: Mapping[str, np.ndarray], seed: int, net: Any = None) -> None:
        nonlocal done
        swap = None
        if net is not None:
            chosen = np.sort(np.random.default_rng(seed).permutation(count)[:swap_pictures])
            swap = swap_test(net, pictures.images[chosen], seed=seed, batch_size=batch_size)
        truth = None
        if len(factors) >= 2:
            truth = ground_truth_scores(blocks, factors, dimensions=dimensions, seed=seed)
        rows[name].append(FeatureScores(pearson(blocks), similarity(blocks, seed=seed), truth, swap))
        done += 1
        if progress is not None:
            progress(done, total)

    sizes = {name: values.shape[1] for name, values in features.items()}
    for seed in seeds:
        add(MODEL, features, seed, model)
        twin = untrained_twin(model, seed)
        fresh = embed_images(twin, pictures.images, batch_size=batch_size)
        add(UNTRAINED, fresh, seed, twin)
        add(SHUFFLED, shuffled_rows(features, seed), seed)
        add(PIXELS, random_pixels(pictures.images, sizes, seed), seed)
    return DisentanglementCard(
        tuple(features), rows, correlation_matrix(features), tuple(sizes.values()), count
    )


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
