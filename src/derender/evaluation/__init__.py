"""Stage 7: scores. Every function says its range and its best value; every protocol carries controls."""

from derender.evaluation.clustering import (
    ClusteringResult,
    at_least,
    cluster_table,
    evaluate_clustering,
    ward,
)
from derender.evaluation.clustering_compare import ClusterComparison, compare_clusterings
from derender.evaluation.clustering_scores import ClusterScores, chance_scores, cluster_scores
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
    "FactorResult",
    "GeometryResult",
    "GeometryScores",
    "LinearComparison",
    "ReconstructionResult",
    "ReconstructionScores",
    "albedo_error",
    "at_least",
    "camera_error",
    "chance_scores",
    "cluster_scores",
    "cluster_table",
    "compare_clusterings",
    "compare_linear",
    "evaluate_clustering",
    "evaluate_factors",
    "evaluate_geometry",
    "evaluate_reconstruction",
    "geometry_scores",
    "light_error",
    "mean_picture",
    "reconstruction_scores",
    "ward",
]
