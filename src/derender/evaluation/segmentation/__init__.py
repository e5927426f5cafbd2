"""Face segmentation from pre-trained U-Net encoders, after the paper's Table 3.

data      images with masks, divided; controls without a network
nets      the networks, their training and their answers
compare   all of it joined: ``segment``
"""

from derender.evaluation.segmentation.compare import (
    SegmentationComparison,
    class_iou,
    count_pixels,
    resampled_scores,
    segment,
)
from derender.evaluation.segmentation.data import SegmentationData, divide
from derender.evaluation.segmentation.nets import VARIANTS, SegmentSettings

__all__ = [
    "VARIANTS", "SegmentSettings", "SegmentationComparison", "SegmentationData", "class_iou", "count_pixels",
    "divide", "resampled_scores", "segment",
]  # fmt: skip
