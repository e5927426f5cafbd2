"""From measures to sentences and a verdict: one finding for each thing that was looked at.

Every threshold stands in the table ``checks.yaml``. Limits were chosen on one half of the material of
lab/doctor.md and checked on the other. Of distinct, unreadable, small, oblong, grey and clipped images they
are conventions: nothing was measured to set them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import yaml

from derender.data.doctor.measures import JackknifeEstimate, SymmetryAxis

Level = Literal["good", "note", "trouble", "objection", "open"]
"""``trouble``: will struggle; ``objection``: does not suit; ``open``: cannot be judged on this set."""

AXIS_OFFSET = 0.06  # an axis of symmetry farther from the middle than this share of the width is off it
AXIS_SYMMETRIC = 0.7  # both sides about an axis correlate by this much where it is one


@dataclass(frozen=True)
class CheckFinding:
    """One thing that was looked at."""

    name: str  # what, in a word or two
    level: Level  # how bad
    text: str  # what was found, one or two plain sentences
    advice: str = ""  # what to do about it; "" where there is nothing to do
    short: str = ""  # the finding as a reason, to stand after "because"; "" for what is no reason
    value: JackknifeEstimate | None = None  # the number behind it with its error, if it is one


@dataclass(frozen=True)
class Verdict:
    """``suits``, ``will struggle`` or ``does not suit``, with the reasons, worst first."""

    word: str
    because: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """In one line."""
        return f"{self.word}, because {'; '.join(self.because)}" if self.because else self.word


def verdict_of(findings: Sequence[CheckFinding]) -> Verdict:
    """The worst level decides; all objections, or else all troubles, are the reasons."""
    for level, word in (("objection", "does not suit"), ("trouble", "will struggle")):
        if reasons := tuple(finding.short for finding in findings if finding.level == level):
            return Verdict(word, reasons)
    return Verdict("suits")


@dataclass(frozen=True)
class Check:
    """How a measure is judged and told.

    Attributes:
        good, bad: the finding as a clause, in order and not.
        noted: of a share (less is better) the value from which on it is worth a note; None for what is better
            the larger it is.
    """

    name: str  # of the finding
    label: str  # of the measure, in tables
    note: str  # what it is, and which way is better
    objects: float | None  # past this a set does not suit; None: it never objects
    struggles: float | None  # past this the method will struggle; None: it never does
    good: str
    bad: str
    advice: str  # what to do about it
    noted: float | None = None


_TABLE = yaml.safe_load(Path(__file__).with_name("checks.yaml").read_text(encoding="utf-8"))
CHECKS = {name: Check(**row) for name, row in _TABLE.items()}  # by the names of the measures


def judged(value: JackknifeEstimate, check: Check) -> tuple[Level, bool]:
    """The level of a value, and whether two standard errors either way keep it there.

    An objection needs certainty: a value past ``objects`` by less than two errors is only trouble.
    """
    sign = 1 if check.noted is None else -1  # so that more is better
    limits = (None if limit is None else sign * limit for limit in (check.objects, check.struggles))
    (objects, struggles), middle, margin = limits, sign * value.value, 2 * value.error
    if objects is not None and middle < objects:
        return ("objection", True) if middle + margin < objects else ("trouble", False)
    if struggles is not None and middle < struggles:
        certain = middle + margin < struggles and (objects is None or middle - margin >= objects)
        return "trouble", certain
    least = struggles if struggles is not None else objects
    noted = check.noted is not None and value.value > check.noted
    return "note" if noted else "good", least is None or middle - margin >= least


def finding_of(name: str, value: JackknifeEstimate, detail: str = "") -> CheckFinding:
    """The finding of one check, as a sentence with its number and further details."""
    check = CHECKS[name]
    level, certain = judged(value, check)
    is_share = check.noted is not None
    number = (
        percent(value.value) if is_share else format(value.value, ",.0f" if value.value >= 1000 else ",.3g")
    )
    clause = check.good if (value.value == 0 if is_share else level == "good") else check.bad
    clause = clause.format(number=number)
    measured = [] if "{number}" in check.bad else [f"{check.label} {number}"]
    if value.error:
        measured.append(f"± {percent(2 * value.error) if is_share else format(2 * value.error, '.2g')}")
    details = (" ".join(measured), "" if certain else "too few images to be sure", detail)
    brackets = "; ".join(filter(None, details))
    text = f"{clause[:1].upper()}{clause[1:]}{f' ({brackets})' if brackets else ''}."
    if level == "good":
        return CheckFinding(check.name, level, text, value=value)
    return CheckFinding(check.name, level, text, check.advice, "" if level == "note" else clause, value)


def findings_of(
    values: Mapping[str, JackknifeEstimate], details: Mapping[str, str], axis: SymmetryAxis | None
) -> tuple[CheckFinding, ...]:
    """A finding for every value; without an axis nothing was compared, and the rest stays open."""
    found = {name: finding_of(name, values[name], details.get(name, "")) for name in CHECKS if name in values}
    if axis is None:
        text = "Alignment, kinds, symmetry and variety were not measured: too few distinct images."
        return (*found.values(), CheckFinding("the rest", "open", text))
    if values["agreement"].value < (CHECKS["agreement"].objects or 0):
        text = "Kinds, symmetry, crop, view and light cannot be judged where images have so little in common."
        counted = list(found)[: list(found).index("agreement") + 1]
        return (*(found[name] for name in counted), CheckFinding("the rest", "open", text))
    if "kinship" not in found:
        found["kinship"] = CheckFinding("kinds", "open", "No two groups are large enough to compare.")
    off = found["symmetry"].level != "good" and axis.correlation > AXIS_SYMMETRIC
    name = "symmetry" if off else "fill"
    if abs(axis.offset) >= AXIS_OFFSET and (off or found[name].level == "good"):
        side = "right" if axis.offset > 0 else "left"
        where = f"Their axis of symmetry lies {percent(abs(axis.offset))} of the width {side} of the middle."
        found[name] = replace(
            found[name],
            level=found[name].level if off else "trouble",
            text=f"{found[name].text} {where}",
            advice=f"Crop further to the {side}, so that the axis is in the middle.",
            short="the axis of symmetry is off the middle",
        )
    if found["light"].level == "objection":  # where both are missing, nothing is left to learn a shape from
        view = values["view"]
        missing = view.value + 2 * view.error < (CHECKS["view"].struggles or 0)
        name, level = ("view", "objection") if missing else ("light", "trouble")
        found[name] = replace(found[name], level=level)
    return tuple(found.values())


def percent(share: float) -> str:
    """A share as people say it; never 0 % for something or 100 % for less than all."""
    if 0 < share < 0.01:
        return "under 1 %"
    return "over 99 %" if 0.99 < share < 1 else f"{100 * share:.0f} %"
