"""A number learned from a sample, with its standard error by the delete-a-group jackknife.

Source: Shao and Tu, The Jackknife and Bootstrap (1995), chapter 2.3. The pictures count as independent draws;
where they come in families (many of one person), the true error is larger.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

GROUPS = 12


@dataclass(frozen=True)
class Estimate:
    """A value and its standard error, both in the measure's own unit."""

    value: float
    error: float

    def text(self, digits: int = 2) -> str:
        """As people read it: value, and twice the error as the range to reckon with."""
        return f"{self.value:.{digits}f} ± {2 * self.error:.{digits}f}"


def jackknife(
    measure: Callable[[Int64[np.ndarray, " k"]], float], count: int, groups: int = GROUPS
) -> Estimate:
    """``measure(rows)`` on all rows, and its standard error from leaving out one group at a time.

    Rows are dealt to the groups in turn. Needs two groups' worth of rows.
    """
    if count < 2 * groups:
        raise ValueError(f"a jackknife over {groups} groups needs {2 * groups} rows or more, got {count}")
    rows = np.arange(count)
    left = np.array([measure(rows[rows % groups != group]) for group in range(groups)])
    spread = (groups - 1) / groups * np.sum((left - left.mean()) ** 2)
    return Estimate(float(measure(rows)), float(np.sqrt(spread)))
