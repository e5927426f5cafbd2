"""Stage 7: protocols that score features and models, each beside its controls.

A protocol is one call that gives ``Scores``: ``cluster``, ``linear``, ``identify``, ``verify``, ``segment``,
``disentangle``, ``geometry``, ``reconstruction``, ``pose``, ``light``, ``relight``, ``brightness``,
``robustness``, and ``compare`` (the paper's tables). Every
function states its range and its best value. docs/reference/metrics.md has a table of them.
"""

from derender.evaluation.angles import light, pose
from derender.evaluation.bootstrap import difference, estimate, resamples
from derender.evaluation.clustering import cluster, compare_clusterings, finch_levels
from derender.evaluation.clustering_methods import clusterings, cut, finch, finch_clusters, ward_tree
from derender.evaluation.clustering_scores import chance_scores, cluster_scores
from derender.evaluation.disentanglement import disentangle
from derender.evaluation.feature_rows import at_least
from derender.evaluation.identity import Pairs, area_under_roc, identify, read_pairs, verify
from derender.evaluation.linear_probes import majority_answers, probe
from derender.evaluation.linear_probing import compare_linear, linear
from derender.evaluation.linear_task import Rows, Task, choose_rows, linear_scores, task_of
from derender.evaluation.paper_comparison import compare
from derender.evaluation.photometry import brightness, relight
from derender.evaluation.pixels import (
    ReconstructionResult,
    evaluate_reconstruction,
    mean_image,
    reconstruction_scores,
)
from derender.evaluation.robust import robustness
from derender.evaluation.scenes import geometry, reconstruction
from derender.evaluation.score_table import Column, Row, Scores, ScoreTable
from derender.evaluation.segmentation import segment
from derender.evaluation.truth import (
    FactorResult,
    GeometryResult,
    albedo_error,
    camera_error,
    evaluate_factors,
    evaluate_geometry,
    geometry_scores,
    light_error,
)

__all__ = [
    "Column", "FactorResult", "GeometryResult", "Pairs", "ReconstructionResult", "Row", "Rows",
    "ScoreTable", "Scores", "Task", "albedo_error", "area_under_roc", "at_least", "brightness",
    "camera_error", "chance_scores", "choose_rows", "cluster", "cluster_scores", "clusterings", "compare",
    "compare_clusterings", "compare_linear", "cut", "difference", "disentangle", "estimate",
    "evaluate_factors", "evaluate_geometry", "evaluate_reconstruction", "finch", "finch_clusters",
    "finch_levels", "geometry", "geometry_scores", "identify", "light", "light_error", "linear",
    "linear_scores", "majority_answers", "mean_image", "pose", "probe", "read_pairs", "reconstruction",
    "reconstruction_scores", "relight", "resamples", "robustness", "segment", "task_of", "verify",
    "ward_tree",
]  # fmt: skip
