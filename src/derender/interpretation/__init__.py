"""Stage 8: which factor made an answer, and where in the picture it was seen.

question: label columns as something to ask; probe: a linear answer, kept in a file; shares: integrated
gradients by factor; explanation: shares over seeds beside controls; cam: maps over the picture; sanity: do
the maps change with the weights; grouping: what made a cluster, what makes two pictures alike.
"""

from derender.interpretation.explanation import Explanation, ShareRow, explain_labels
from derender.interpretation.grouping import ClusterShares, PairParts, cluster_shares, pair_parts
from derender.interpretation.probe import Probe, fit_probe, load_probe
from derender.interpretation.question import question

__all__ = [
    "ClusterShares",
    "Explanation",
    "PairParts",
    "Probe",
    "ShareRow",
    "cluster_shares",
    "explain_labels",
    "fit_probe",
    "load_probe",
    "pair_parts",
    "question",
]
