"""What a finding and a verdict are, and how a number with an error is held against a limit."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from derender.data.doctor.estimate import Estimate

Level = Literal["good", "note", "trouble", "objection", "open"]
"""``trouble``: will struggle; ``objection``: does not suit; ``open``: cannot be judged on this set."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: what, in a word or two.
        level: how bad.
        text: what was found, one or two plain sentences.
        advice: what to do about it; "" where there is nothing to do.
        short: the finding as a reason, to stand after "because"; "" for what is no reason.
        value: the number behind it with its error, if it is one.
    """

    name: str
    level: Level
    text: str
    advice: str = ""
    short: str = ""
    value: Estimate | None = None


@dataclass(frozen=True)
class Verdict:
    """``suits``, ``will struggle`` or ``does not suit``, with the reasons, worst first."""

    word: Literal["suits", "will struggle", "does not suit"]
    because: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """In one line."""
        return f"{self.word}, because {'; '.join(self.because)}" if self.because else self.word


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """The worst level decides; all objections, or else all troubles, are the reasons."""
    objections = tuple(finding.short for finding in findings if finding.level == "objection")
    if objections:
        return Verdict("does not suit", objections)
    troubles = tuple(finding.short for finding in findings if finding.level == "trouble")
    if troubles:
        return Verdict("will struggle", troubles)
    return Verdict("suits")


def judged(value: Estimate, objects: float | None, struggles: float | None) -> tuple[Level, bool]:
    """The level of a value of which more is better, and whether two standard errors either way keep it there.

    An objection needs certainty: a value below ``objects`` by less than two errors is only trouble.
    """
    low, high = value.value - 2 * value.error, value.value + 2 * value.error
    if objects is not None and value.value < objects:
        return ("objection", True) if high < objects else ("trouble", False)
    if struggles is not None and value.value < struggles:
        return "trouble", high < struggles and (objects is None or low >= objects)
    limit = struggles if struggles is not None else objects
    return "good", limit is None or low >= limit


def doubt(certain: bool) -> str:
    """What to add in brackets where two standard errors reach across a limit."""
    return "" if certain else "; too few pictures to be sure"
