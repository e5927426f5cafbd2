"""From measures to sentences and a verdict: one finding for each thing that was looked at.

Every threshold stands in ``CHECKS``. Limits were chosen on one half of the material of docs/doctor.md and
checked on the other; those of distinct, unreadable, small and clipped are conventions: nothing was measured
to set them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from derender.data.doctor.measures import JackknifeEstimate, SymmetryAxis

Level = Literal["good", "note", "trouble", "objection", "open"]
"""``trouble``: will struggle; ``objection``: does not suit; ``open``: cannot be judged on this set."""

AXIS_OFFSET = 0.06  # an axis of symmetry farther from the middle than this share of the width is off it
AXIS_SYMMETRIC = 0.7  # both sides about an axis correlate by this much where it is one
NOTE_SHARE = 0.1
"""Of images that are small, oblong, grey or clipped, a share above this is worth a note, by convention."""


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


CHECKS = {
    "distinct": Check(
        "number", "distinct images", "copies and near copies counted once; more is better", 100, 1000,
        "{number} distinct images", "{number} distinct images are too few",
        "Add images: a few thousand different ones of the same kind of thing.",
    ),
    "copies": Check(
        "copies", "copies", "share of all images; less is better", None, 0.3,
        "no image is a copy or near copy", "{number} of the images are copies or near copies",
        "Training drops copies to the pixel; delete near copies, or some end up on both sides of a split.", 0,
    ),
    "unreadable": Check(
        "files", "unreadable", "share of all files; less is better", None, 0.2,
        "every file can be read", "{number} of the files cannot be read",
        "They are left out; the list of unreadable files says why.", 0,
    ),
    "small": Check(
        "sizes", "small", "share of files below the examined size; less is better", None, 0.5,
        "no file is too small", "{number} of the files are smaller than the examined size",
        "Small images are enlarged, which blurs them: find larger ones.", NOTE_SHARE,
    ),
    "oblong": Check(
        "shapes", "oblong", "share of files far from square; less is better", None, None,
        "every file is about square", "{number} of the files are far from square, cropped to their middle",
        "Look whether the thing is still in the image, and crop around it if not.", NOTE_SHARE,
    ),
    "clipped": Check(
        "brightness", "clipped", "mean share of black or white pixels; less is better", None, 0.3,
        "no pixel is black or white", "{number} of all pixels are black or white",
        "Where pixels are clipped no shading is left: see whether it is the thing or the background.",
        NOTE_SHARE,
    ),
    "blank": Check(
        "empty images", "empty", "share of images of one brightness; less is better", None, None,
        "no image is empty", "{number} of the images show one brightness only",
        "Delete empty images.", 0,
    ),
    "grey": Check(
        "colour", "grey", "share of images without colour", None, None,
        "all images are in colour", "{number} of the images are grey",
        "Features distinguish grey from colour: leave the fewer out. Of grey images the albedo is grey.",
        NOTE_SHARE,
    ),
    "agreement": Check(
        "alignment", "agreement", "mean cosine between the edges of two images; 0: unrelated", 0.1, 0.18,
        "the images show the same thing at the same place",
        "the images have too little in common at the same place",
        "Take images of one kind of thing, and crop them all alike: the same points at the same place.",
    ),
    "kinship": Check(
        "kinds", "kinship", "agreement across the two most different groups over that within", 0.45, None,
        "even the two most different groups share their structure", "they fall into two kinds of thing",
        "One model learns one kind of thing: train on one of the two groups, or on each by itself.",
    ),
    "odd": Check(
        "out-of-distribution", "unlike the others", "share of images; less is better", None, 0.05,
        "no image is unlike the others", "{number} of the images are unlike the others",
        "Look at the least typical ones and delete what does not belong.", 0.05,
    ),
    "symmetry": Check(
        "symmetry", "symmetry", "agreement with other mirror images over agreement; best 1", 0.6, 0.85,
        "on average left mirrors right", "left does not mirror right (seen from one side only?)",
        "One shape explains an image and its mirror image: add views from the other side, or mirror half.",
    ),
    "fill": Check(
        "crop", "frame filled", "share of the image that the common structure covers", None, 0.56,
        "the thing fills the image", "the thing is small in the image",
        "Crop more tightly: the thing should fill the image and leave little background.",
    ),
    "view": Check(
        "view", "variety of view", "distance to the own over that to others' mirror images", None, 0.72,
        "the viewpoint varies", "all are seen from the same side",
        "Add images with the thing turned left and right: depth shows by what moves.",
    ),
    "light": Check(
        "light", "variety of light", "standard deviation of left against right", 0.015, 0.035,
        "the lighting varies", "all are lit alike",
        "Add images lit from the left and from the right: shading shows how the surface bends.",
    ),
}  # fmt: skip
"""By the names of the measures."""


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
