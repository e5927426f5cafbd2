"""Feeds broken configurations, tables, models, checkpoints, caches, archives and images to their readers.

    python tests/trust/fuzz.py --inputs 100000 --seed 0

What is a finding stands in fuzzing/found.py. Each kind is told once, with the input; the same seed makes the
same inputs again. fuzz_atheris.py looks for inputs by what they make the readers do.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from fuzzing.found import Found, limit_memory, quiet
from fuzzing.targets import Target, targets
from hypothesis import HealthCheck, Phase, given, seed, settings


def fuzz(target: Target, inputs: int, number: int) -> Found:
    """Feed a reader so many inputs; what it refuses is counted, what escapes is kept."""
    found = Found()

    def one(value: Any) -> None:
        found.feed(target, value)

    chosen = settings(
        max_examples=inputs,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    seed(number)(chosen(given(target.inputs)(one)))()
    return found


def run(given_: argparse.Namespace) -> int:
    """The script."""
    total = findings = 0
    limit_memory()
    with tempfile.TemporaryDirectory() as place, quiet():
        for target in targets(Path(place)):
            if given_.only and given_.only not in target.name:
                continue
            began = time.monotonic()
            found = fuzz(target, max(1, round(given_.inputs * target.share)), given_.seed)
            total, findings = total + found.inputs, findings + len(found.findings)
            print(
                f"{target.name}: {found.inputs:,} inputs, {found.accepted:,} read, "
                f"{len(found.findings)} findings, slowest {found.slowest:.2f} s, "
                f"{time.monotonic() - began:.0f} s in all",
                flush=True,
            )
            for kind, example in found.findings.items():
                print(f"  {kind} ({found.times[kind]}): {example}", flush=True)
    print(f"{total:,} inputs, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="targets whose name holds this")
    sys.exit(run(parser.parse_args()))
