"""Joint training with a target task: the paper's future work.

task: both objectives as a task of the training loop; pixel_labels: a batch's labels; model: what is trained
and saved; score: held-out scores beside heads on frozen features.
"""

from derender.evaluation.finetuning.model import FinetunedModel, TargetHead, load_finetuned
from derender.evaluation.finetuning.score import FinetuneScores, score_finetuned
from derender.evaluation.finetuning.task import FinetuneTask, Target, target_loss, target_of

__all__ = [
    "FinetuneScores",
    "FinetuneTask",
    "FinetunedModel",
    "Target",
    "TargetHead",
    "load_finetuned",
    "score_finetuned",
    "target_loss",
    "target_of",
]
