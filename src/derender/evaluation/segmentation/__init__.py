"""Face segmentation from pre-trained U-Net encoders, after the paper's Table 3.

pixels: pictures with masks, divided; variants: which encoders; train: how; scores; controls: answers without
a net; compare: all of it joined.
"""

from derender.evaluation.segmentation.compare import (
    SegmentationComparison,
    SegmentationRow,
    compare_segmentations,
)
from derender.evaluation.segmentation.pixels import SegmentationData, divide
from derender.evaluation.segmentation.scores import SegmentationScores, count_pixels, segmentation_scores
from derender.evaluation.segmentation.train import SegmentSettings, answer, train_segmenter
from derender.evaluation.segmentation.variants import VARIANTS, Variant, build_variant, chosen_variants

__all__ = [
    "VARIANTS",
    "SegmentSettings",
    "SegmentationComparison",
    "SegmentationData",
    "SegmentationRow",
    "SegmentationScores",
    "Variant",
    "answer",
    "build_variant",
    "chosen_variants",
    "compare_segmentations",
    "count_pixels",
    "divide",
    "segmentation_scores",
    "train_segmenter",
]
