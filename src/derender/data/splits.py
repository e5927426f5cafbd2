"""Divides images into train, validation and test, the same way on every machine.

Files are put in the order of a hash of their name and the seed, and that order is cut. So the split depends
on neither the file system nor a random generator's version, and counts are exact. An image added later moves
only those few that lie at a cut. With groups (identities), whole groups are ordered and cut: no person is on
two sides.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Split:
    """Three disjoint, sorted arrays of row numbers that together are all rows."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray


def split_indices(
    files: int | Sequence[str],
    fractions: tuple[float, float, float] = (0.8, 0.1, 0.1),
    *,
    seed: int = 0,
    groups: Sequence[object] | np.ndarray | None = None,
) -> Split:
    """Split rows, given by their file names (or only their number), in these fractions.

    Without groups the three counts are the fractions of the total, made whole. With groups, each cut is the
    one between groups that comes nearest. A group "" or NaN is unknown: such rows stand alone.
    """
    if any(not 0 <= fraction <= 1 for fraction in fractions) or abs(sum(fractions) - 1) > 1e-6:
        raise ValueError(f"split fractions must be three numbers in 0..1 that add up to 1, got {fractions}")
    names = [str(row) for row in range(files)] if isinstance(files, int) else list(files)
    keys = names
    if groups is not None:
        if len(groups) != len(names):
            raise ValueError(f"expected one group for each of {len(names)} images, got {len(groups)}")
        alone = [str(group) in ("", "nan") for group in groups]
        rows = zip(names, groups, alone, strict=True)
        keys = [f"file {name}" if single else f"group {group}" for name, group, single in rows]
    members: dict[str, list[int]] = {}
    for row, key in enumerate(keys):
        members.setdefault(key, []).append(row)

    def digest(key: str) -> bytes:
        return hashlib.sha256(f"{seed}\0{key}".encode("utf-8", "surrogateescape")).digest()

    ordered = sorted(members, key=digest)
    ends = np.cumsum([0, *(len(members[key]) for key in ordered)])
    targets = np.cumsum(_counts(len(names), fractions))
    cuts = [int(np.abs(ends - end).argmin()) for end in targets[:2]]
    parts = (ordered[: cuts[0]], ordered[cuts[0] : cuts[1]], ordered[cuts[1] :])
    return Split(*(np.array(sorted(row for key in part for row in members[key]), np.int64) for part in parts))


def _counts(total: int, fractions: tuple[float, float, float]) -> list[int]:
    """Whole numbers in these proportions that add up to the total (largest remainders round up)."""
    exact = [total * fraction for fraction in fractions]
    counts = [int(value + 1e-9) for value in exact]
    by_remainder = sorted(range(3), key=lambda part: counts[part] - exact[part])
    for part in by_remainder[: total - sum(counts)]:
        counts[part] += 1
    return counts
