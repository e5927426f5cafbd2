"""Broken inputs to every reader; the script takes as many as it is told."""

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).with_name("fuzz.py")


def test_readers_refuse_what_is_broken_and_nothing_else_escapes():
    told = [sys.executable, str(SCRIPT), "--inputs", "600", "--seed", "5"]
    done = subprocess.run(
        told, capture_output=True, text=True, timeout=280, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.strip().splitlines()[-1]
    assert last.endswith(" inputs, 0 findings") and int(last.split()[0].replace(",", "")) >= 600
