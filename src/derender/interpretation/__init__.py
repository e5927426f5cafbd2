"""Which factor made an answer, and where in the image it was seen.

probe: label columns as a question, and a linear probe of it; attribution: integrated gradients by factor,
maps over the image and their sanity check; explanation: shares over seeds beside controls; tables: all of
it as tables, and parts of clusters and pairs.
"""

from derender.interpretation.explanation import Explained, explain, explain_labels
from derender.interpretation.probe import Probe, fit_probe, load_probe, question
from derender.interpretation.tables import (
    ClusterShares,
    Explanation,
    PairParts,
    ShareRow,
    cluster_shares,
    pair_parts,
)

__all__ = [
    "ClusterShares", "Explained", "Explanation", "PairParts", "Probe", "ShareRow", "cluster_shares",
    "explain", "explain_labels", "fit_probe", "load_probe", "pair_parts", "question",
]  # fmt: skip
