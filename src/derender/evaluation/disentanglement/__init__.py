"""Are the features disentangled? Correlations, similarity, the swap test, and scores against true factors.

pearson, similarity     between features, from a feature table alone
ridge                   held-out linear prediction, which several scores use
swap                    one factor exchanged, rendered, encoded again
true_factors, importance, ground_truth_scores   DCI, MIG, SAP and R2 where the true factors are known
card                    all of it beside controls, over seeds
"""

from derender.evaluation.disentanglement.card import (
    DisentanglementCard,
    FeatureScores,
    dealt,
    evaluate_disentanglement,
    random_pixels,
    shuffled_rows,
    swap_interval,
)
from derender.evaluation.disentanglement.ground_truth_scores import (
    GroundTruthScores,
    ModularityScores,
    dci,
    ground_truth_scores,
    mutual_information,
)
from derender.evaluation.disentanglement.importance import importance
from derender.evaluation.disentanglement.pearson import (
    PearsonScores,
    correlation_matrix,
    pearson,
    per_image,
)
from derender.evaluation.disentanglement.ridge import fit_predict, held_out, r_squared
from derender.evaluation.disentanglement.similarity import SimilarityScores, linear_cka, similarity
from derender.evaluation.disentanglement.swap import SwapScores, diagonal_over_rest, swap_test
from derender.evaluation.disentanglement.true_factors import TrueFactor, left_out, true_factors

__all__ = [
    "DisentanglementCard",
    "FeatureScores",
    "GroundTruthScores",
    "ModularityScores",
    "PearsonScores",
    "SimilarityScores",
    "SwapScores",
    "TrueFactor",
    "correlation_matrix",
    "dci",
    "dealt",
    "diagonal_over_rest",
    "evaluate_disentanglement",
    "fit_predict",
    "ground_truth_scores",
    "held_out",
    "importance",
    "left_out",
    "linear_cka",
    "mutual_information",
    "pearson",
    "per_image",
    "r_squared",
    "random_pixels",
    "shuffled_rows",
    "similarity",
    "swap_interval",
    "swap_test",
    "true_factors",
]
