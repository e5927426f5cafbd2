"""Training on a GPU: replayed steps give the bits of ordinary ones, and runs resume exactly in either way."""

import json

import numpy as np
import pytest
import torch

from derender.data import ImageSet
from derender.model import load
from derender.training import train
from derender.training.config import resolve

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

SMALL = (
    *("image_size=32", "batch_size=8", "images=800", "validate_every=400", "checkpoint_every=400"),
    *("self_features_steps=20", "pictures=0", "deterministic=true", "loocc=all", "cycle_weight=0.1"),
)


def trained(folder, *overrides, **how):
    pixels = np.random.default_rng(0).integers(0, 256, (80, 3, 32, 32), dtype=np.uint8)
    images = ImageSet(
        images=pixels, files=tuple(f"{i:03d}.png" for i in range(80)), source="made by the test"
    )
    train(resolve("small", (*SMALL, *overrides)), images, folder, **how)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    notes = [line["text"] for line in lines if line["kind"] == "note"]
    return load(folder / "model").state_dict(), notes


def same(one, other) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


def test_replayed_steps_are_ordinary_steps(tmp_path):
    replayed, notes = trained(tmp_path / "replayed")
    ordinary, silent = trained(tmp_path / "ordinary", "cuda_graph=off")
    assert len(notes) == 1 and "CUDA graph" in notes[0] and not silent
    assert same(replayed, ordinary)


def test_a_template_start_is_recorded_anew_for_each_of_its_phases(tmp_path):
    shares = ("template_share=0.6", "release_share=0.1")
    replayed, notes = trained(tmp_path / "replayed", *shares)
    ordinary, _ = trained(tmp_path / "ordinary", *shares, "cuda_graph=off")
    assert len(notes) == 1 and same(replayed, ordinary)


def test_a_run_resumes_to_the_same_weights_in_either_way(tmp_path):
    whole, _ = trained(tmp_path / "whole")
    trained(tmp_path / "parts", "images=400")
    resumed, _ = trained(tmp_path / "parts", "cuda_graph=off", resume=True)
    assert same(whole, resumed)
