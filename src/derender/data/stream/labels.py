"""Label columns of a stream, where what kind of column one is shows only when all values have been seen.

Text stays text; numbers become float32, yes/no int8 (data/layout.py). A column of several kinds is text, and
so are whole numbers that float32 cannot hold (above 2^24: identifiers, as a rule).
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum

import numpy as np

from derender.data.layout import number_column, text_column
from derender.data.stream.sample import Value

_EXACT_IN_FLOAT32 = 1 << 24


class Kind(StrEnum):
    """What a column holds."""

    TEXT = "text"
    NUMBER = "number"
    FLAG = "flag"


class Kinds(dict[str, Kind | None]):
    """The kind of each column so far; None while only unknown values were seen."""

    def see(self, labels: Mapping[str, Value]) -> None:
        """Take one picture's labels into account."""
        for name, value in labels.items():
            self.join(name, _kind(value))

    def join(self, name: str, kind: Kind | None) -> None:
        """Take a kind into account that a column has elsewhere."""
        known = self.get(name)
        self[name] = kind if known is None else known if kind in (None, known) else Kind.TEXT


def column_of(name: str, rows: Iterable[Mapping[str, Value]], kind: Kind | str | None) -> np.ndarray:
    """One label column of a given kind; unknown values are "", NaN or -1."""
    values: Sequence[Value] = [row.get(name) for row in rows]
    if kind == Kind.NUMBER:
        return number_column(np.nan if value is None else float(value) for value in values)
    if kind == Kind.FLAG:
        return np.array([-1 if value is None else int(value) for value in values], np.int8)
    return text_column("" if value is None else str(value) for value in values)


def _kind(value: Value) -> Kind | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return Kind.FLAG
    if isinstance(value, int):
        return Kind.NUMBER if abs(value) <= _EXACT_IN_FLOAT32 else Kind.TEXT
    return Kind.NUMBER if isinstance(value, float) else Kind.TEXT
