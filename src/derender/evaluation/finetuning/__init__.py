"""Joint training with labels, the paper's future work: the task of the training loop, and held-out scores."""

from derender.evaluation.finetuning.joint import (
    FinetunedModel,
    FinetuneTask,
    JointLabels,
    TargetHead,
    load_finetuned,
    target_loss,
    target_of,
)
from derender.evaluation.finetuning.score import FinetuneScores, score_finetuned

__all__ = [
    "FinetuneScores", "FinetuneTask", "FinetunedModel", "JointLabels", "TargetHead", "load_finetuned",
    "score_finetuned", "target_loss", "target_of",
]  # fmt: skip
