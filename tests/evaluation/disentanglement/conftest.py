"""A disentanglement card of features whose scores are known."""

import numpy as np

from derender.evaluation import disentanglement as scored
from derender.evaluation.disentanglement.card import DisentanglementCard, FeatureScores
from derender.evaluation.disentanglement.ground_truth import TrueFactor
from derender.evaluation.disentanglement.similarity import correlation_matrix
from derender.evaluation.disentanglement.swap import SwapScores

NAMES = ("light", "camera")
MOVED = np.array([[0.9, 0.3], [0.1, 0.7]])


def card(seeds: int = 2, known: bool = True) -> DisentanglementCard:
    numbers = np.random.default_rng(0).uniform(-1, 1, (80, 2))
    blocks = {"light": numbers[:, :1], "camera": numbers[:, 1:]}
    factors = [TrueFactor(f"{name} yaw", numbers[:, k], False, (name,)) for k, name in enumerate(NAMES)]

    def scores(of: dict[str, np.ndarray], seed: int, swap: bool) -> FeatureScores:
        truth = scored.ground_truth_scores(of, factors, dimensions="lasso", seed=seed) if known else None
        test = SwapScores(NAMES, MOVED, MOVED, MOVED[0], MOVED[1], MOVED[0] / 2, 4.0 + seed, 4.0, 80)
        similarity = scored.similarity(of, seed=seed)
        return FeatureScores(scored.pearson(of), similarity, truth, test if swap else None)

    noise = {name: values[::-1] for name, values in blocks.items()}
    rows = {
        "model": [scores(blocks, seed, True) for seed in range(seeds)],
        "shuffled rows": [scores(noise, seed, False) for seed in range(seeds)],
    }
    return DisentanglementCard(NAMES, rows, correlation_matrix(blocks), (1, 1), 80)
