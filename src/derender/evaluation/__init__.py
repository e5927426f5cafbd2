"""Stage 7: scores. Every function says its range and its best value; every protocol carries controls."""

from derender.evaluation.clustering import (
    ClusteringResult,
    ClusterScores,
    at_least,
    chance_scores,
    cluster_scores,
    cluster_table,
    evaluate_clustering,
    ward,
)
from derender.evaluation.factors import (
    AngleScores,
    FactorResult,
    albedo_error,
    camera_error,
    evaluate_factors,
    light_error,
)
from derender.evaluation.geometry import GeometryResult, GeometryScores, evaluate_geometry, geometry_scores
from derender.evaluation.reconstruction import (
    ReconstructionResult,
    ReconstructionScores,
    evaluate_reconstruction,
    mean_picture,
    reconstruction_scores,
)

__all__ = [
    "AngleScores",
    "ClusterScores",
    "ClusteringResult",
    "FactorResult",
    "GeometryResult",
    "GeometryScores",
    "ReconstructionResult",
    "ReconstructionScores",
    "albedo_error",
    "at_least",
    "camera_error",
    "chance_scores",
    "cluster_scores",
    "cluster_table",
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
