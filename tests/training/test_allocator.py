"""Freed memory is reused inside the block."""

import resource
import sys

import pytest
import torch

from derender.training.process import freed_memory_kept

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mallopt is glibc's")


def page_faults_of_ten_blocks() -> int:
    """Minor faults while a block of 64 MB is filled and freed ten times."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        torch.ones(16 * 2**20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def test_freed_memory_is_reused_inside_the_block():
    page_faults_of_ten_blocks()
    outside = page_faults_of_ten_blocks()
    with freed_memory_kept() as kept:
        if not kept:
            pytest.skip("the C library has no mallopt")
        page_faults_of_ten_blocks()
        inside = page_faults_of_ten_blocks()
    assert outside > 1_000
    assert inside < outside / 4
