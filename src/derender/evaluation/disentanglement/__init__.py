"""Are the features disentangled? Correlations, similarity, the swap test, and scores against true factors.

similarity     Pearson, CKA and cross-prediction between features, from a feature table alone
swap           one factor exchanged, rendered, encoded again
ground_truth   DCI, MIG, SAP and R2 where the true factors are known
card           all of it beside controls, over seeds: ``disentangle``
"""

from derender.evaluation.disentanglement.card import DisentanglementCard, FeatureScores, disentangle
from derender.evaluation.disentanglement.ground_truth import (
    TrueFactor,
    dci,
    ground_truth_scores,
    importance,
    mutual_information,
)
from derender.evaluation.disentanglement.similarity import correlation_matrix, linear_cka, pearson, similarity
from derender.evaluation.disentanglement.swap import SwapScores, diagonal_over_rest, swap_test

__all__ = [
    "DisentanglementCard", "FeatureScores", "SwapScores", "TrueFactor", "correlation_matrix", "dci",
    "diagonal_over_rest", "disentangle", "ground_truth_scores", "importance", "linear_cka",
    "mutual_information", "pearson", "similarity", "swap_test",
]  # fmt: skip
