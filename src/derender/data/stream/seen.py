"""Which pixels came before, for streams of any length: 24 bytes a picture.

Digests lie in sorted runs, each at least twice as long as the next (a log-structured merge), so that a batch
is looked up in all of them by bisection and a run is copied a logarithmic number of times.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

DIGEST_BYTES = 16


class SeenPixels:
    """A growing map from digest to the number of the first row that had it."""

    def __init__(self) -> None:
        self._runs: list[tuple[np.ndarray, np.ndarray]] = []

    def __len__(self) -> int:
        return sum(len(digests) for digests, _ in self._runs)

    def first(self, digests: Sequence[bytes], rows: Sequence[int]) -> Int64[np.ndarray, " n"]:
        """For each digest the row that had it first, itself if new; new ones are remembered.

        Args:
            digests: sixteen bytes each.
            rows: the numbers of these pictures, in order.
        """
        keys = np.array(digests, dtype=f"S{DIGEST_BYTES}")
        numbers = np.array(rows, dtype=np.int64)
        if not len(keys):
            return numbers
        unique, position, inverse = np.unique(keys, return_index=True, return_inverse=True)
        found = numbers[position]
        known = np.zeros(len(unique), bool)
        for run_keys, run_rows in self._runs:
            place = np.minimum(np.searchsorted(run_keys, unique), len(run_keys) - 1)
            hit = run_keys[place] == unique
            found[hit] = run_rows[place[hit]]
            known |= hit
        if not known.all():
            self._add(unique[~known], found[~known])
        return found[inverse.reshape(-1)]

    def _add(self, keys: np.ndarray, rows: np.ndarray) -> None:
        while self._runs and len(self._runs[-1][0]) < 2 * len(keys):
            more_keys, more_rows = self._runs.pop()
            keys, rows = np.concatenate([more_keys, keys]), np.concatenate([more_rows, rows])
            order = np.argsort(keys, kind="stable")
            keys, rows = keys[order], rows[order]
        self._runs.append((keys, rows))
