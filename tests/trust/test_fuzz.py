"""Broken inputs to every reader; the script takes as many as it is told."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("fuzz.py")


def test_readers_refuse_what_is_broken_and_nothing_else_escapes():
    told = [sys.executable, str(SCRIPT), "--inputs", "600", "--seed", "5"]
    done = subprocess.run(
        told, capture_output=True, text=True, timeout=280, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.strip().splitlines()[-1]
    assert last.endswith(" inputs, 0 findings") and int(last.split()[0].replace(",", "")) >= 600


def test_what_a_search_by_coverage_starts_from_is_read_and_rubbish_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    module = importlib.import_module("fuzzing.targets")
    made_again = {"remembered results (npz)", "decoded images (cache)"}
    searched = 0
    for target in module.targets(tmp_path):
        for whole in target.wholes:
            target.read(target.given(whole))
            searched += 1
        if target.wholes and target.name not in made_again:
            with pytest.raises(module.REFUSALS):
                target.read(target.given(b"[rubbish\xff"))
    assert searched >= 16
