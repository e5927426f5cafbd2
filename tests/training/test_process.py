"""The process of a run: torch's switch goes back; freed memory is reused."""

import subprocess
import sys

import pytest
import torch

from derender.training.process import deterministic_algorithms


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("deterministic", [False, True])
def test_the_switch_is_turned_back(before, deterministic):
    torch.use_deterministic_algorithms(before, warn_only=before)
    try:
        with pytest.raises(KeyError), deterministic_algorithms(deterministic):
            assert torch.are_deterministic_algorithms_enabled() is deterministic
            raise KeyError
        assert torch.are_deterministic_algorithms_enabled() is before
        assert torch.is_deterministic_algorithms_warn_only_enabled() is before
    finally:
        torch.use_deterministic_algorithms(False)


FAULTS = """
import resource, torch
from derender.training.process import freed_memory_kept
def faults():  # minor ones, while a block of 64 MB is filled and freed twenty times
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    [torch.ones(16 * 2**20) is None for _ in range(20)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
outside = faults()
with freed_memory_kept() as kept:
    print(int(kept), outside, faults())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mallopt is glibc's")
def test_freed_memory_is_reused_inside_the_block():
    ended = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, timeout=120)
    kept, outside, inside = map(int, ended.stdout.split())  # a fresh process: no block is free to be reused
    if not kept:
        pytest.skip("the C library has no mallopt")
    assert outside > 1_000 and inside < outside / 4


def test_fabric_comes_without_torchmetrics_which_stays_whole():
    code = """
import sys
from derender.training.distributed import open_fabric
assert open_fabric("cpu").world_size == 1 and "torchmetrics" not in sys.modules
from torchmetrics.functional.classification import multiclass_stat_scores
assert open_fabric("cpu").world_size == 1 and "torchmetrics" in sys.modules
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
