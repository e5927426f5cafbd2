"""Features extracted once, kept in one table, scored many times.

table: the value; parquet: its file; extract: model and images to features; transformer: for scikit-learn;
embedding: images to a table in memory or a file (blocks: on the way there); neighbours: nearest rows.
"""

from functools import partial
from typing import TYPE_CHECKING

from derender import on_first_use
from derender.features.extract import (
    Progress,
    embed_image_set,
    embed_images,
    evaluating,
    map_batches,
    model_fingerprint,
    table_labels,
)
from derender.features.table import FeatureTable, chosen, missing, named

if TYPE_CHECKING:
    from derender.features.embedding import Embedded, embed, embed_to_file, unlike_training
    from derender.features.neighbours import search
    from derender.features.transformer import DisentangledFeatures

__all__ = [
    "DisentangledFeatures", "Embedded", "FeatureTable", "Progress", "chosen", "embed", "embed_image_set",
    "embed_images", "embed_to_file", "evaluating", "map_batches", "missing", "model_fingerprint", "named",
    "search", "table_labels", "unlike_training",
]  # fmt: skip

_HOME: dict[str, str] = dict.fromkeys(("Embedded", "embed", "embed_to_file", "unlike_training"), "embedding")
_HOME |= {"search": "neighbours", "DisentangledFeatures": "transformer"}
# scikit-learn and pyarrow are slow to import, and decomposing an image needs neither
__getattr__ = partial(on_first_use, __name__, _HOME)
