"""Whether a set of images suits the method, before anyone trains: ``doctor``.

Each of the measures (measures.py) becomes a finding by the limits in ``checks.yaml``, all of them a verdict.
Limits were chosen on one half of the material of lab/doctor.md and checked on the other. Those on distinct,
unreadable, small, oblong, grey and clipped images are conventions: nothing was measured to set them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int64

from derender.data.doctor import measures
from derender.data.doctor.measures import JackknifeEstimate, jackknife
from derender.data.image_set import ImageSet, read_images
from derender.data.opening import ListedStream, open_images
from derender.data.source import evenly_spaced, is_image
from derender.data.stream import Progress
from derender.storage.bounded import table_beside

Level = Literal["good", "note", "trouble", "objection", "open"]
"""``trouble``: will struggle; ``objection``: does not suit; ``open``: cannot be judged on this set."""
WORDS = {"objection": "NO", "trouble": "!", "note": "note", "open": "?", "good": "ok"}  # worst first

AXIS_OFFSET = 0.06  # an axis of symmetry farther from the middle than this share of the width is off it
AXIS_SYMMETRIC = 0.7  # both sides about an axis correlate by this much where it is one

EXAMINED_PX = 64  # side at which images are read for an examination
COMPARED = 4_000  # most distinct images that are compared with one another, evenly spaced
FEWEST_COMPARED = 2 * measures.GROUPS  # fewer distinct images do not show what they share
ODD_LIKENESS = 0.15  # an image less like the others than this is unlike all of them
SHOWN = 8  # images in each row of examples, at most


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
    """How a measure is judged and told."""

    name: str  # of the finding
    label: str  # of the measure, in tables
    note: str  # what it is, and which way is better
    objects: float | None  # past this a set does not suit; None: it never objects
    struggles: float | None  # past this the method will struggle; None: it never does
    good: str  # the finding as a clause where it is in order
    bad: str  # and where not
    advice: str  # what to do about it
    noted: float | None = None  # of a share (less is better) what is worth a note; None: more is better


CHECKS = {name: Check(**row) for name, row in table_beside(__file__, "checks.yaml").items()}  # by measure


def judged(value: JackknifeEstimate, check: Check) -> tuple[Level, bool]:
    """The level of a value, and whether two standard errors either way keep it there.

    An objection needs certainty: a value past ``objects`` by less than two errors is only trouble.
    """
    sign = 1 if check.noted is None else -1  # so that more is better
    objects, struggles = (-np.inf if one is None else sign * one for one in (check.objects, check.struggles))
    middle, margin = sign * value.value, 2 * value.error
    if middle < objects:
        return ("objection", True) if middle + margin < objects else ("trouble", False)
    if middle < struggles:
        return "trouble", middle + margin < struggles and middle - margin >= objects
    noted = check.noted is not None and value.value > check.noted
    return "note" if noted else "good", middle - margin >= max(objects, struggles)


def finding_of(name: str, value: JackknifeEstimate, detail: str = "") -> CheckFinding:
    """The finding of one check, as a sentence with its number and further details."""
    check = CHECKS[name]
    level, certain = judged(value, check)
    is_share = check.noted is not None
    plain = format(value.value, ",.0f" if value.value >= 1000 else ",.3g")
    number = percent(value.value) if is_share else plain
    in_order = value.value == 0 if is_share else level == "good"
    clause = (check.good if in_order else check.bad).format(number=number)
    measured = [] if "{number}" in check.bad else [f"{check.label} {number}"]
    if value.error:
        measured.append(f"± {percent(2 * value.error) if is_share else format(2 * value.error, '.2g')}")
    unsure = "" if certain else "too few images to be sure"
    brackets = "; ".join(filter(None, (" ".join(measured), unsure, detail)))
    text = f"{clause[:1].upper()}{clause[1:]}{f' ({brackets})' if brackets else ''}."
    advice, reason = ("" if level == "good" else check.advice), "" if level in ("good", "note") else clause
    return CheckFinding(check.name, level, text, advice, reason, value)


def findings_of(
    values: Mapping[str, JackknifeEstimate], details: Mapping[str, str], axis: measures.SymmetryAxis | None
) -> tuple[CheckFinding, ...]:
    """A finding for every value; without an axis nothing was compared, and the rest stays open."""
    known = [name for name in CHECKS if name in values]
    result = {name: finding_of(name, values[name], details.get(name, "")) for name in known}
    if axis is None:
        text = "Alignment, kinds, symmetry and variety were not measured: too few distinct images."
        return (*result.values(), CheckFinding("the rest", "open", text))
    if values["agreement"].value < (CHECKS["agreement"].objects or 0):
        text = "Kinds, symmetry, crop, view and light cannot be judged where images have so little in common."
        counted = list(result)[: list(result).index("agreement") + 1]
        return (*(result[name] for name in counted), CheckFinding("the rest", "open", text))
    if "kinship" not in result:
        result["kinship"] = CheckFinding("kinds", "open", "No two groups are large enough to compare.")
    off = result["symmetry"].level != "good" and axis.correlation > AXIS_SYMMETRIC
    one = result[name := "symmetry" if off else "fill"]
    if abs(axis.offset) >= AXIS_OFFSET and (off or one.level == "good"):
        side = "right" if axis.offset > 0 else "left"
        where = f"Their axis of symmetry lies {percent(abs(axis.offset))} of the width {side} of the middle."
        advice = f"Crop further to the {side}, so that the axis is in the middle."
        level, short = (one.level if off else "trouble"), "the axis of symmetry is off the middle"
        result[name] = replace(one, level=level, text=f"{one.text} {where}", advice=advice, short=short)
    if result["light"].level == "objection":  # where both are missing, nothing is left to learn a shape from
        missing = values["view"].value + 2 * values["view"].error < (CHECKS["view"].struggles or 0)
        name, level = ("view", "objection") if missing else ("light", "trouble")
        result[name] = replace(result[name], level=level)
    return tuple(result.values())


def percent(share: float) -> str:
    """A share as people say it; never 0 % for something or 100 % for less than all."""
    if 0 < share < 0.01:
        return "under 1 %"
    return "over 99 %" if 0.99 < share < 1 else f"{100 * share:.0f} %"


@dataclass(frozen=True)
class Shared:
    """What distinct images share."""

    rows: Int64[np.ndarray, " k"]  # that were compared
    values: Mapping[str, JackknifeEstimate]  # measures by their names in ``CHECKS``
    axis: measures.SymmetryAxis
    orders: Mapping[tuple[str, str], Float[np.ndarray, " k"]]  # of the rows, by the names of their two ends


@dataclass(frozen=True)
class Examination:
    """What was found in images."""

    images: ImageSet  # those examined
    verdict: Verdict  # whether the set suits the method
    findings: tuple[CheckFinding, ...]  # one for each thing looked at
    values: Mapping[str, JackknifeEstimate]  # every measured number by its name in ``CHECKS``
    group: Int64[np.ndarray, " n"]  # the first image of each image's group of copies and near copies
    identical: int  # copies to the last pixel, the first of each not counted
    originals: measures.Originals | None  # sizes of the files, or None for a stream
    shared: Shared | None  # None where too few distinct images show anything
    examples: Mapping[str, tuple[int, ...]]  # rows of images by what they show ("most typical", "one group")

    @property
    def mean(self) -> Float[np.ndarray, "3 s s"] | None:
        """The compared images' mean, 0..1, or None where too few were compared."""
        if self.shared is None:
            return None
        return self.images.images[self.shared.rows].mean(axis=0, dtype=np.float64) / 255

    def describe(self) -> str:
        """What was found, worst first, one a line, and the verdict."""
        ranked = sorted(self.findings, key=lambda one: list(WORDS).index(one.level))
        lines = [f"{WORDS[one.level]:>4}  {one.name}: {one.text} {one.advice}".rstrip() for one in ranked]
        return "\n".join([*lines, f"verdict: {self.verdict.text}"])

    __repr__ = describe

    def as_json(self) -> dict[str, Any]:
        """What ``derender doctor --json`` writes."""
        files, shared = self.images.files, self.shared
        compared = {} if shared is None else {**shared.values, "axis": shared.axis}
        kinship = compared.pop("kinship", None)
        copies = [(row, first) for row, first in enumerate(self.group) if row != first]
        return {
            "source": self.images.source,
            "verdict": self.verdict.word,
            "because": self.verdict.because,
            "findings": self.findings,
            "pictures": len(files),
            "distinct": len(files) - len(copies),
            "identical": self.identical,
            "near_copies": len(copies) - self.identical,
            **{name: self.values[name].value for name in ("clipped", "grey")},
            "blank": round(self.values["blank"].value * len(files)),
            "originals": self.originals,
            "compared": 0 if shared is None else len(shared.rows),
            "measures": compared or None,
            "kinship": kinship,
            "unreadable": self.images.skipped,
            "copies": [{"file": files[row], "first": files[first]} for row, first in copies],
        }


def doctor(
    images: str | Path | ImageSet, *, dataset: str = "auto", limit: int | None = None, seed: int = 0,
    progress: Progress | None = None,
) -> Examination:  # fmt: skip
    """Say whether images suit the method: copies, crop, symmetry, view and light. Trains nothing.

    Args:
        images: a folder, zip, shards or data set as ``read_images`` takes it. Or a set that was read with
            ``keep_duplicates=True`` at a multiple of 32 pixels.
        dataset, limit: as of ``read_images``.
        seed: of the random splits in two groups; the same images and seed give the same examination.
        progress: called with (done, total), first of reading, then of examining.
    """
    originals = None
    if not isinstance(images, ImageSet):
        if Path(images).is_file() and is_image(str(images)):
            raise ValueError(f"{images} is one image: a set is examined as a whole, give its folder or zip")
        with open_images(images, dataset=dataset, limit=limit) as stream:
            images = read_images(stream, EXAMINED_PX, keep_duplicates=True, progress=progress)
            if isinstance(stream, ListedStream):
                originals = measures.measure_originals(stream.files, images.files, EXAMINED_PX)
    if (count := len(images)) == 0:
        raise ValueError(f"there is no image to examine in {images.source}")
    pixels = measures.measure_pixels(images.images, progress)
    group = measures.near_copy_groups(pixels.tiny)
    distinct = np.unique(group)
    shared = _compare(images, distinct[~pixels.blank[distinct]], np.random.default_rng(seed))
    copies, kept = count - len(distinct), set(images.files)
    identical = sum(row.file in kept for row in images.duplicates)
    shares = {
        "distinct": len(distinct),
        "copies": 1 - len(distinct) / count,
        "unreadable": len(images.skipped) / (len(images.skipped) + count),
        "clipped": pixels.clipped.mean(),
        "blank": pixels.blank.mean(),
        "grey": pixels.colourless.mean(),
    }
    details = {}
    if copies:
        nearly = copies - identical
        details["copies"] = f"{copies:,} of {count:,}: {identical:,} to the pixel, {nearly:,} nearly"
    if originals is not None:
        shares |= {"small": originals.smaller, "oblong": originals.oblong}
        details["small"] = f"short sides: {originals.median_short:,} pixels in the median"
    values = {name: JackknifeEstimate(float(value)) for name, value in shares.items()}
    values |= {} if shared is None else shared.values
    findings = findings_of(values, details, None if shared is None else shared.axis)
    result = verdict_of(findings), findings, values, group, identical, originals, shared
    return Examination(images, *result, _examples(pixels.blank, group, shared))


def quick_verdict(images: ImageSet) -> str:
    """The verdict on at most 400 images of a multiple of 32 pixels; "" where they suit, or are others."""
    if images.images.shape[-1] % 32:
        return ""
    findings = doctor(images.select(evenly_spaced(len(images), 400))).findings
    if len(images) > 400:  # a sample does not show how many there are
        findings = tuple(finding for finding in findings if finding.name != CHECKS["distinct"].name)
    return "" if (verdict := verdict_of(findings)).word == "suits" else verdict.text


def _compare(images: ImageSet, rows: np.ndarray, generator: np.random.Generator) -> Shared | None:
    """Compare distinct images; None of too few."""
    if len(rows) < FEWEST_COMPARED:
        return None
    rows = rows[evenly_spaced(len(rows), COMPARED)]
    count, parts = len(rows), np.array_split(rows, -(-len(rows) // 256))
    grey = np.concatenate([measures.shrunk(images.images[part]) for part in parts])
    edges, sides = measures.structure_of(measures.edge_cells(grey)), measures.side_light(grey)
    alike = measures.likeness(edges)
    odd = float((alike < ODD_LIKENESS).mean())
    of_edges = {"agreement": measures.agreement, "symmetry": measures.symmetry}
    of_edges |= {"fill": measures.frame_filled, "view": measures.view_variety}
    values = {name: jackknife(lambda kept, of=of: of(edges[kept]), count) for name, of in of_edges.items()}
    values["light"] = jackknife(lambda kept: measures.light_variety(sides[kept]), count)
    values["odd"] = JackknifeEstimate(odd, float(np.sqrt(odd * (1 - odd) / count)))
    orders = {
        ("least typical", "most typical"): alike,
        ("nearest their mirror image", "farthest from it"): measures.own_mirror_distance(edges),
        ("brightest on the right", "brightest on the left"): sides.mean(axis=1),
    }
    if (halves := measures.split_in_two(edges, generator)) is not None:
        values["kinship"], margin = halves
        if values["kinship"].value < (CHECKS["kinship"].objects or 0):
            orders["one group", "the other group"] = margin
    return Shared(rows, values, measures.symmetry_axis(grey), orders)


def _examples(blank: np.ndarray, group: np.ndarray, shared: Shared | None) -> dict[str, tuple[int, ...]]:
    """Images for the page, by what they show; those of the extremes are extreme, no pick."""
    examples: dict[str, np.ndarray] = {}
    if len(copies := np.flatnonzero(group != np.arange(len(group)))):
        some = copies[evenly_spaced(len(copies), SHOWN // 2)]
        examples["copies, in pairs"] = np.stack([group[some], some], axis=1).ravel()
    if blank.any():
        examples["empty"] = np.flatnonzero(blank)
    if shared is None:
        examples["all distinct"] = np.unique(group)
    elif shared.values["agreement"].value < (CHECKS["agreement"].objects or 0):
        examples["evenly through the set"] = shared.rows
    else:
        for (low, high), values in shared.orders.items():
            order = shared.rows[np.argsort(values)]
            examples |= {low: order[:SHOWN], high: order[::-1][:SHOWN]}
    return {name: tuple(rows[evenly_spaced(len(rows), SHOWN)].tolist()) for name, rows in examples.items()}
