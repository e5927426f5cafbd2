"""Feeds broken configurations, tables, models, checkpoints, caches, archives and pictures to their readers.

    python tests/trust/fuzz.py --inputs 100000 --seed 0

A reader may refuse an input with ValueError or OSError, which the command line tells in one line; anything
else that escapes, an input that takes longer than ``SLOW_SECONDS``, and one that makes the process ask for
``LARGE_BYTES`` more than before, is a finding. The whole process may take ``ADDRESS_BYTES``. Each kind of
finding is told once, with the input; the same seed makes the same inputs again.
"""

import argparse
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzzing.targets import REFUSALS, Target, targets
from hypothesis import HealthCheck, Phase, given, seed, settings

SLOW_SECONDS = 5.0
LARGE_BYTES = 2**30
ADDRESS_BYTES = 14 * 2**30  # a page may claim 2 GiB, which is reserved, not used; torch maps a few by itself


@dataclass
class Found:
    """What came of one target: inputs, how many were accepted, findings by kind with an example."""

    inputs: int = 0
    accepted: int = 0
    slowest: float = 0.0
    findings: dict[str, str] = field(default_factory=dict)
    times: Counter[str] = field(default_factory=Counter)


def fuzz(target: Target, inputs: int, number: int) -> Found:
    """Feed a reader so many inputs; what it refuses is counted, what escapes is kept."""
    found = Found()

    def one(value: Any) -> None:
        found.inputs += 1
        before = peak_bytes()
        began = time.process_time()
        try:
            target.read(value)
            found.accepted += 1
        except REFUSALS as refused:
            if isinstance(refused.__cause__, MemoryError):
                found.times["memory"] += 1
                found.findings.setdefault("memory", f"{refused.__cause__} <- {value!r:.300}")
        except Exception as escaped:
            where = traceback.extract_tb(escaped.__traceback__)
            ours = [
                frame for frame in where if "derender" in frame.filename and "trust" not in frame.filename
            ]
            frame = (ours or where)[-1]
            kind = f"{type(escaped).__name__} at {Path(frame.filename).name}:{frame.lineno}"
            found.times[kind] += 1
            found.findings.setdefault(kind, f"{' '.join(str(escaped).split())[:200]} <- {value!r:.300}")
        if peak_bytes() - before > LARGE_BYTES:
            found.times["large"] += 1
            found.findings.setdefault("large", f"{peak_bytes() - before:,} bytes more <- {value!r:.300}")
        took = time.process_time() - began
        found.slowest = max(found.slowest, took)

    chosen = settings(
        max_examples=inputs,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    seed(number)(chosen(given(target.inputs)(one)))()
    if found.slowest > SLOW_SECONDS:
        found.findings["slow"] = f"one input took {found.slowest:.1f} s of processor time"
    return found


def peak_bytes() -> int:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextmanager
def quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def run(given_: argparse.Namespace) -> int:
    """The script."""
    total = findings = 0
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
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
