"""Stage 7: scores. Every function says its range and its best value; every protocol carries controls.

Here: clustering, linear probes, geometry, factors, reconstruction, intervals. Further scores on arrays:
``evaluation.disentanglement``, ``evaluation.segmentation``, ``evaluation.robustness``; joint training:
``evaluation.finetuning``. docs/evaluation.md has a table of them.
"""

from derender.evaluation.bootstrap import Difference, Estimate, ScoredRow, difference, estimate, resamples
from derender.evaluation.clustering import (
    ClusteringResult,
    at_least,
    cluster_table,
    evaluate_clustering,
    ward,
)
from derender.evaluation.clustering_compare import ClusterComparison, compare_clusterings
from derender.evaluation.clustering_finch import FinchHierarchy, finch, finch_clusters
from derender.evaluation.clustering_levels import Level, finch_levels
from derender.evaluation.clustering_methods import clusterings
from derender.evaluation.clustering_scores import ClusterScores, chance_scores, cluster_scores
from derender.evaluation.clustering_ward import cut, ward_tree
from derender.evaluation.factors import (
    AngleScores,
    FactorResult,
    albedo_error,
    camera_error,
    evaluate_factors,
    light_error,
)
from derender.evaluation.geometry import GeometryResult, GeometryScores, evaluate_geometry, geometry_scores
from derender.evaluation.linear_compare import LinearComparison, compare_linear
from derender.evaluation.linear_probes import majority_answers, probe
from derender.evaluation.linear_scores import LinearScores, linear_scores
from derender.evaluation.linear_task import Rows, Task, choose_rows, task_of
from derender.evaluation.reconstruction import (
    ReconstructionResult,
    ReconstructionScores,
    evaluate_reconstruction,
    mean_picture,
    reconstruction_scores,
)

__all__ = [
    "AngleScores",
    "ClusterComparison",
    "ClusterScores",
    "ClusteringResult",
    "Difference",
    "Estimate",
    "FactorResult",
    "FinchHierarchy",
    "GeometryResult",
    "GeometryScores",
    "Level",
    "LinearComparison",
    "LinearScores",
    "ReconstructionResult",
    "ReconstructionScores",
    "Rows",
    "ScoredRow",
    "Task",
    "albedo_error",
    "at_least",
    "camera_error",
    "chance_scores",
    "choose_rows",
    "cluster_scores",
    "cluster_table",
    "clusterings",
    "compare_clusterings",
    "compare_linear",
    "cut",
    "difference",
    "estimate",
    "evaluate_clustering",
    "evaluate_factors",
    "evaluate_geometry",
    "evaluate_reconstruction",
    "finch",
    "finch_clusters",
    "finch_levels",
    "geometry_scores",
    "light_error",
    "linear_scores",
    "majority_answers",
    "mean_picture",
    "probe",
    "reconstruction_scores",
    "resamples",
    "task_of",
    "ward",
    "ward_tree",
]
