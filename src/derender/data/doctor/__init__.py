"""Whether a set of images suits the method, before anyone trains: ``doctor``.

measures has what is measured; findings makes sentences and a verdict of it, by the thresholds in checks.yaml.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from derender.data.doctor import measures
from derender.data.doctor.findings import CHECKS, CheckFinding, Verdict, findings_of, percent, verdict_of
from derender.data.doctor.measures import JackknifeEstimate, evenly, jackknife, measure_originals
from derender.data.image_set import ImageSet, read_images
from derender.data.opening import ListedStream, open_images
from derender.data.source import is_image

__all__ = [
    "CHECKS", "CheckFinding", "Examination", "Verdict", "doctor", "measure_originals", "percent",
]  # fmt: skip

EXAMINED_PX = 64  # side at which images are read for an examination
COMPARED = 4_000  # most distinct images that are compared with one another, evenly spaced
FEWEST_COMPARED = 2 * measures.GROUPS  # with fewer distinct images nothing can be said about what they share
ODD_LIKENESS = 0.15  # an image less like the others than this is unlike all of them
SHOWN = 8  # images in each row of examples, at most


@dataclass(frozen=True)
class Shared:
    """What distinct images share. Rows that were compared; measures by their names in ``CHECKS``; the axis of
    symmetry; orders of these images by the names of their two ends.
    """

    rows: Int64[np.ndarray, " k"]
    values: Mapping[str, JackknifeEstimate]
    axis: measures.SymmetryAxis
    orders: Mapping[tuple[str, str], Float[np.ndarray, " k"]]


@dataclass(frozen=True)
class Examination:
    """What was found in images.

    Attributes:
        verdict, findings: whether the set suits the method, and one finding for each thing looked at.
        examples: rows of images by what they show ("most typical", "least typical", "one group", ...).
    """

    images: ImageSet  # those examined
    verdict: Verdict
    findings: tuple[CheckFinding, ...]
    values: Mapping[str, JackknifeEstimate]  # every measured number by its name in ``CHECKS``
    group: Int64[np.ndarray, " n"]  # the first image of each image's group of copies and near copies
    identical: int  # copies to the last pixel, the first of each not counted
    originals: measures.Originals | None  # sizes of the files, or None for a stream
    shared: Shared | None  # None where too few distinct images show anything
    examples: Mapping[str, tuple[int, ...]]

    @property
    def mean(self) -> Float[np.ndarray, "3 s s"] | None:
        """The compared images' mean, 0..1, or None where too few were compared."""
        if self.shared is None:
            return None
        return self.images.images[self.shared.rows].mean(axis=0, dtype=np.float64) / 255

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
            "clipped": self.values["clipped"].value,
            "grey": self.values["grey"].value,
            "blank": round(self.values["blank"].value * len(files)),
            "originals": self.originals,
            "compared": 0 if shared is None else len(shared.rows),
            "measures": compared or None,
            "kinship": kinship,
            "unreadable": self.images.skipped,
            "copies": [{"file": files[row], "first": files[first]} for row, first in copies],
        }


def doctor(
    images: str | Path | ImageSet,
    *,
    dataset: str = "auto",
    limit: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], object] | None = None,
) -> Examination:
    """Say whether images suit the method: copies, crop, symmetry, view and light. Trains nothing.

    Args:
        images: a folder, zip, shards or data set as ``read_images`` takes it. Or a set that was read with
            ``keep_duplicates=True`` at a multiple of 32 pixels.
        dataset: the layout's name, or "auto" to recognise it.
        limit: examine at most so many images.
        seed: of the random splits in two groups; the same images and seed give the same examination.
        progress: called with (done, total), first of reading, then of examining.
    """
    originals = None
    if not isinstance(images, ImageSet):
        source = images
        if Path(source).is_file() and is_image(str(source)):
            raise ValueError(f"{source} is one image: a set is examined as a whole, give its folder or zip")
        how = {"dataset": dataset, "limit": limit, "keep_duplicates": True, "progress": progress}
        images = read_images(source, EXAMINED_PX, **how)
        with open_images(source, dataset=dataset) as stream:
            if isinstance(stream, ListedStream):
                originals = measure_originals(stream.files, images.files, EXAMINED_PX)
    count, unreadable = len(images), len(images.skipped)
    if count == 0:
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
        "unreadable": unreadable / (unreadable + count),
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
    examples = _examples(pixels, group, shared)
    verdict = verdict_of(findings)
    return Examination(images, verdict, findings, values, group, identical, originals, shared, examples)


def quick_verdict(images: ImageSet) -> str:
    """The verdict on at most 400 images of a multiple of 32 pixels; "" where they suit, or are others."""
    if images.images.shape[-1] % 32:
        return ""
    verdict = doctor(images.select(evenly(len(images), 400))).verdict
    return "" if verdict.word == "suits" else verdict.text


def _compare(
    images: ImageSet, rows: Int64[np.ndarray, " n"], generator: np.random.Generator
) -> Shared | None:
    """Compare distinct images; None of too few."""
    if len(rows) < FEWEST_COMPARED:
        return None
    rows = rows[evenly(len(rows), COMPARED)]
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


def _examples(
    pixels: measures.Pixels, group: np.ndarray, shared: Shared | None
) -> dict[str, tuple[int, ...]]:
    """Images for the page, by what they show; those of the extremes are extreme, no pick."""
    examples: dict[str, np.ndarray] = {}
    copies = np.flatnonzero(group != np.arange(len(group)))
    if len(copies):
        some = copies[evenly(len(copies), SHOWN // 2)]
        examples["copies, in pairs"] = np.stack([group[some], some], axis=1).ravel()

    def spread(title: str, rows: np.ndarray) -> None:
        examples[title] = rows[evenly(len(rows), SHOWN)]

    if pixels.blank.any():
        spread("empty", np.flatnonzero(pixels.blank))
    if shared is None:
        spread("all distinct", np.unique(group))
    elif shared.values["agreement"].value < (CHECKS["agreement"].objects or 0):
        spread("evenly through the set", shared.rows)
    else:
        for (low, high), values in shared.orders.items():
            order = shared.rows[np.argsort(values)]
            examples |= {low: order[:SHOWN], high: order[::-1][:SHOWN]}
    return {name: tuple(map(int, rows)) for name, rows in examples.items()}
