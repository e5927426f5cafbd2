"""Broken inputs to every reader, in a process of their own; the script takes as many as it is told."""

import os
import subprocess
import sys
from pathlib import Path


def test_readers_refuse_what_is_broken_and_nothing_else_escapes():
    script = Path(__file__).with_name("fuzz.py")
    told = [sys.executable, str(script), "--inputs", "600", "--seed", "5"]
    one = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(told, capture_output=True, text=True, timeout=280, env=one)
    assert done.returncode == 0, done.stdout + done.stderr
    *readers, last = done.stdout.strip().splitlines()
    assert len(readers) == 14 and all(int(row.split(",")[1].split()[0]) > 0 for row in readers)
    assert last.endswith(" inputs, 0 findings") and int(last.split()[0].replace(",", "")) >= 600
