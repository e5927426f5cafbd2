"""What became of a reader's inputs: accepted, refused, or a finding.

A reader may refuse an input with ValueError or OSError, which the command line tells in one line; anything
else that escapes, an input that takes longer than ``SLOW_SECONDS``, and one that makes the process ask for
``LARGE_BYTES`` more than before, is a finding. Each kind of finding is kept once, with the input.
"""

import resource
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzzing.targets import REFUSALS, Target

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

    def feed(self, target: Target, value: Any) -> None:
        """Give a reader one input; what it refuses is counted, what escapes is kept."""
        self.inputs += 1
        before = peak_bytes()
        began = time.process_time()
        try:
            target.read(value)
            self.accepted += 1
        except REFUSALS as refused:
            if isinstance(refused.__cause__, MemoryError):
                self.keep("memory", f"{refused.__cause__} <- {value!r:.300}")
        except Exception as escaped:
            where = traceback.extract_tb(escaped.__traceback__)
            ours = [
                frame for frame in where if "derender" in frame.filename and "trust" not in frame.filename
            ]
            frame = (ours or where)[-1]
            kind = f"{type(escaped).__name__} at {Path(frame.filename).name}:{frame.lineno}"
            self.keep(kind, f"{' '.join(str(escaped).split())[:200]} <- {value!r:.300}")
        if peak_bytes() - before > LARGE_BYTES:
            self.keep("large", f"{peak_bytes() - before:,} bytes more <- {value!r:.300}")
        took = time.process_time() - began
        self.slowest = max(self.slowest, took)
        if took > SLOW_SECONDS:
            self.keep("slow", f"{took:.1f} s of processor time <- {value!r:.300}")

    def keep(self, kind: str, example: str) -> None:
        self.times[kind] += 1
        self.findings.setdefault(kind, example)


def limit_memory() -> None:
    """The whole process may take ``ADDRESS_BYTES``."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))


def peak_bytes() -> int:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextmanager
def quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
