"""Feeds broken configurations, tables, models, checkpoints, caches, archives and images to their readers.

    python tests/trust/fuzz.py --inputs 100000 --seed 0

A reader may refuse an input with ValueError or OSError, which the command line tells in one line. Anything
else that escapes, an input that takes longer than ``SLOW_SECONDS``, and one that makes the process ask for
``LARGE_BYTES`` more than before, is a finding; so is a whole file that is refused, or rubbish that is not.
Each kind is told once, with the input; the same seed makes the same inputs again.
"""

import resource
import sys
import tempfile
import time
import traceback
import warnings
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzzing.targets import REFUSALS, Target, targets
from hypothesis import HealthCheck, Phase, given, seed, settings

SLOW_SECONDS = 5.0
LARGE_BYTES = 2**30
ADDRESS_BYTES = 14 * 2**30  # a page may claim 2 GiB, which is reserved, not used; torch maps a few by itself
RUBBISH = b"[rubbish\xff"


@dataclass
class Found:
    """What came of one target: inputs, how many were accepted, findings by kind with an example."""

    target: Target
    inputs: int = 0
    accepted: int = 0
    slowest: float = 0.0
    findings: dict[str, str] = field(default_factory=dict)
    times: Counter[str] = field(default_factory=Counter)

    def feed(self, value: Any) -> bool:
        """Give the reader one input, and keep what escapes; whether it was read."""
        before, began, read = peak_bytes(), time.process_time(), False
        try:
            self.target.read(value)
            read = True
        except REFUSALS as refused:
            if isinstance(refused.__cause__, MemoryError):
                self.keep("memory", str(refused.__cause__), value)
        except Exception as escaped:
            where = traceback.extract_tb(escaped.__traceback__)
            ours = [one for one in where if "derender" in one.filename and "trust" not in one.filename]
            frame = (ours or where)[-1]
            place = f"{Path(frame.filename).name}:{frame.lineno}"
            self.keep(f"{type(escaped).__name__} at {place}", " ".join(str(escaped).split())[:200], value)
        took, more = time.process_time() - began, peak_bytes() - before
        if more > LARGE_BYTES:
            self.keep("large", f"{more:,} bytes more", value)
        if took > SLOW_SECONDS:
            self.keep("slow", f"{took:.1f} s of processor time", value)
        self.inputs, self.accepted = self.inputs + 1, self.accepted + read
        self.slowest = max(self.slowest, took)
        return read

    def keep(self, kind: str, what: str, value: Any) -> None:
        self.times[kind] += 1
        self.findings.setdefault(kind, f"{what} <- {value!r:.300}")

    def tell(self, more: str = "") -> int:
        """Say what came of it; gives the number of findings."""
        message = f"{self.target.name}: {self.inputs:,} inputs, {self.accepted:,} read, {len(self.findings)}"
        print(f"{message} findings, slowest {self.slowest:.2f} s{more}", flush=True)
        for kind, example in self.findings.items():
            print(f"  {kind} ({self.times[kind]}): {example}", flush=True)
        return len(self.findings)


def peak_bytes() -> int:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def limited_and_quiet() -> None:
    """The whole process may take ``ADDRESS_BYTES`` and gives no warnings."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
    warnings.simplefilter("ignore")


def fuzz(target: Target, inputs: int, number: int) -> Found:
    """Feed a reader whole files, rubbish, and so many generated inputs."""
    result = Found(target)
    for whole in target.wholes:
        if not result.feed(value := target.given(whole)):
            result.keep("whole", "is refused", value)
    if target.wholes and not target.made_again and result.feed(target.given(RUBBISH)):
        result.keep("rubbish", "is read", RUBBISH)
    only = {"phases": [Phase.generate], "suppress_health_check": list(HealthCheck)}
    chosen = settings(max_examples=inputs, deadline=None, database=None, **only)

    def one(value: Any) -> None:
        result.feed(value)

    seed(number)(chosen(given(target.inputs)(one)))()
    return result


def run(asked: Namespace) -> int:
    """The script."""
    limited_and_quiet()
    total = findings = 0
    with tempfile.TemporaryDirectory() as place:
        for target in targets(Path(place)):
            if asked.only in target.name:
                result = fuzz(target, max(1, round(asked.inputs * target.share)), asked.seed)
                total, findings = total + result.inputs, findings + result.tell()
    print(f"{total:,} inputs, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="targets whose name holds this")
    sys.exit(run(parser.parse_args()))
