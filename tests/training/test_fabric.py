"""Fabric comes without torchmetrics; whoever asks for that, afterwards or before, has the real one."""

import subprocess
import sys

import pytest

SCORE = "from torchmetrics.functional.classification import multiclass_stat_scores as score"


@pytest.mark.parametrize("order", ["fabric first", "torchmetrics first"])
def test_torchmetrics_is_whole_for_whoever_asks_for_it(order):
    fabric = """
import sys
from derender.training.distributed import DDPStrategy, Fabric
loaded = sorted(name for name in sys.modules if name.split(".")[0] == "torchmetrics")
"""
    code = f"{fabric}assert not loaded, loaded\n{SCORE}" if order == "fabric first" else f"{SCORE}{fabric}"
    code += """
import torch
assert score(torch.tensor([0, 1]), torch.tensor([0, 1]), num_classes=2, average="none").shape == (2, 5)
assert Fabric(accelerator="cpu", devices=1).world_size == 1
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
