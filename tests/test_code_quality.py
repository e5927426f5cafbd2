"""ruff and pyright run with the tests, in the versions that constraints.txt names."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMY = "--max-semi-space-size=128"  # in which node collects garbage less often, a tenth faster


def complaints(*command: str) -> str:
    """What a tool has to say about the checkout; empty when it is content."""
    words, env = [sys.executable, "-m", *command], {**os.environ, "NODE_OPTIONS": ROOMY}
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=250, env=env)
    return "" if done.returncode == 0 else f"{done.stdout}{done.stderr}"


def test_ruff_finds_nothing():
    assert not (result := complaints("ruff", "check", "--quiet", "--output-format=concise", ".")), result


def test_code_is_formatted():
    result = complaints("ruff", "format", "--quiet", "--diff", ".")
    assert not result, f"run: make format\n{result}"


def test_pyright_finds_nothing():
    assert not (result := complaints("pyright", "--pythonpath", sys.executable)), result
