"""ruff and pyrefly run with the tests, in the versions that constraints.txt names."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def complaints(*command: str) -> str:
    """What a tool has to say about the checkout; empty when it is content."""
    words = [sys.executable, "-m", *command]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=250)
    return "" if done.returncode == 0 else f"{done.stdout}{done.stderr}"


def test_ruff_finds_nothing():
    assert not (result := complaints("ruff", "check", "--quiet", "--output-format=concise", ".")), result


def test_code_is_formatted():
    result = complaints("ruff", "format", "--quiet", "--diff", ".")
    assert not result, f"run: make format\n{result}"


def test_types_fit():
    how = ["--output-format=min-text", "--summary=none", "--python-interpreter-path", sys.executable]
    assert not (result := complaints("pyrefly", "check", *how)), result
