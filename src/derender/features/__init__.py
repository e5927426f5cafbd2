"""Stage 6: features extracted once, kept in one table, scored many times.

table: the value; parquet: its file; extract: model and pictures in, table out; transformer: the same for
    scikit-learn; embedding: any source to a file, never whole in memory (batches, parts: its halves);
    blocks, ray_engine: the same on many machines; search: nearest rows by one factor.
"""

from derender.features.embedding import Embedded, embed_to_file
from derender.features.extract import (
    Progress,
    embed_images,
    embed_pictures,
    map_batches,
    model_fingerprint,
    table_labels,
)
from derender.features.table import FeatureTable, missing, named
from derender.features.transformer import DisentangledFeatures

__all__ = [
    "DisentangledFeatures",
    "Embedded",
    "FeatureTable",
    "Progress",
    "embed_images",
    "embed_pictures",
    "embed_to_file",
    "map_batches",
    "missing",
    "model_fingerprint",
    "named",
    "table_labels",
]
