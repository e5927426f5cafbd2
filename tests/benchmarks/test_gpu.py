"""The GPU script goes through on the CPU at tiny sizes; what it says of its aims follows from its numbers."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def gpu():
    """The script as a module."""
    before = list(sys.path)
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("gpu")
    finally:
        sys.path[:] = before


def test_embedding_and_memory_go_through(gpu):
    sizes = replace(gpu.DRY, chunks=(1, 2))
    found = gpu.time_embedding(sizes)
    assert found["against_training"] == found["images_per_second"] / found["training_images_per_second"] > 0
    rows = gpu.measure_memory(sizes)["rows"]
    assert [(row["pixels"], row["chunks"]) for row in rows] == [(32, 1), (32, 2)]


def test_the_real_loop_goes_through(gpu):
    found = gpu.time_epochs(gpu.DRY)
    assert found["shown"] == 16 and found["stopped"] == "images"
    assert 0 < found["seconds"] <= found["wall_seconds"] and 0 <= found["waiting"] < 1


def test_aims_are_reached_or_not_or_not_known(gpu):
    row = {"step": f"derender, {gpu.TARGET}, graph", "images_per_second": 15_000.0, "against_literal": 9.0}
    results = {
        "training": {"rows": [{"step": "literal, float32", "images_per_second": 90_000.0}, row]},
        "epochs": {"wall_seconds": 100.0},
        "embedding": {"failed": "out of memory"},
    }
    reached = {aim["what"]: (aim["got"], aim["reached"]) for aim in gpu.aims(results)}
    assert reached["training step with LOOCC, images/s"] == (15_000.0, True)
    assert reached["the same, against literal"] == (9.0, False)
    assert reached["30 epochs of UTKFace, s"] == (100.0, True)
    assert reached["embedding against training"] == (None, False)
    assert not any(aim["reached"] for aim in gpu.aims({}))


def test_without_a_device_or_the_interpreter_it_says_what_to_do(gpu, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--dry-run"])
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(SystemExit, match="set TRITON_INTERPRET=1 before it"):
        gpu.main()
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    monkeypatch.setattr(gpu.torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="--dry-run tries the script without one"):
        gpu.main()
