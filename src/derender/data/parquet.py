"""The footer of a parquet file, held against the file before a library reads it or takes memory for it.

Readers reserve memory for as many rows as the footer names: one changed byte of a file of 2 kB can ask for
18 GB. And pyarrow 26 looks at a damaged footer with C++ exceptions that end the process. So the footer is
read here as plain numbers (Thrift's compact protocol, parquet-format's ``parquet.thrift``) and compared
with itself and with the size of the file. Leaves out the pages behind the footer.
"""

from collections.abc import Sequence
from io import BufferedIOBase
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyarrow as pa

ALWAYS_ALLOWED_BYTES = 512 * 2**20
MOST_EXPANSION = 1000
"""Of features that are all the same some files expand hundreds of times, of real ones not ten times."""

_DEEPEST = 32
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 11, 12
_INTEGERS = (4, 5, 6)
_REPEATED = 2
_WIDTHS = {0: 1, 1: 4, 3: 12, 4: 4}  # bytes of a value by physical type; else 8 or more


def checked_footer(file: BufferedIOBase, size: int) -> int:
    """The number of rows of a file of ``size`` bytes, if all that its footer claims can be.

    Raises:
        OSError: there is none.
        ValueError: what is damaged or cannot be, in words: numbers of rows and values that contradict each
            other, sizes beyond the file's, and values that would take more than 512 MiB and more than 1000
            times the size of the file.
    """
    file.seek(max(0, size - 8))
    end = file.read(8)
    length = int.from_bytes(end[:4], "little")
    if len(end) < 8 or end[4:] != b"PAR1" or length + 12 > size:
        raise OSError("no parquet footer at its end")
    file.seek(size - 8 - length)
    try:
        return _checked(_Reader(file.read(length)).struct(), size)
    except (LookupError, TypeError, AttributeError, UnicodeDecodeError) as error:
        raise ValueError("a footer that is none") from error


def check_lists(rows: int, schema: "pa.Schema", size: int) -> None:
    """ValueError if lists of a fixed length, of which a footer counts nothing, would take too much."""
    import pyarrow as pa

    widest = [kind.list_size for kind in schema.types if pa.types.is_fixed_size_list(kind)]
    _bounded(4 * rows * sum(widest), size)


def _checked(footer: dict[int, Any], size: int) -> int:
    leaves = _leaves(footer[2])
    rows = compressed = taken = 0
    for group in footer[4]:
        count, columns = int(group[3]), group[1]
        if count < 0:
            raise ValueError(f"{count:,} rows")
        if len(columns) != len(leaves):
            raise ValueError(f"{len(columns)} columns where the schema has {len(leaves)}")
        for (name, width, repeated), column in zip(leaves, columns, strict=True):
            if 8 in column or 9 in column:
                raise ValueError("encrypted columns")
            values, unpacked, packed = (int(column[3][field]) for field in (5, 6, 7))
            if values < count or (values > count and not repeated):
                raise ValueError(f"{values:,} values of {name} in {count:,} rows")
            if min(packed, unpacked) < 0:
                raise ValueError(f"a size of {name} below zero")
            compressed += packed
            taken += max(values * width, unpacked)
        rows += count
    if rows != footer[3]:
        raise ValueError(f"{footer[3]:,} rows, its parts have {rows:,}")
    if compressed > size:
        raise ValueError(f"{compressed:,} bytes of columns in a file of {size:,}")
    _bounded(taken, size)
    return rows


def _bounded(taken: int, size: int) -> None:
    if taken > max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * size):
        raise ValueError(f"{taken:,} bytes of values in a file of {size:,}")


def _leaves(elements: Sequence[dict[int, Any]]) -> list[tuple[str, int, bool]]:
    """Of every column its path with dots, the bytes of a value, and whether a row may hold several.

    The schema's tree stands in the order of a walk through it; its root is no column.
    """
    found: list[tuple[str, int, bool]] = []
    following = iter(elements[1:])

    def walk(children: int, path: tuple[str, ...], repeated: bool) -> None:
        if len(path) > _DEEPEST:
            raise ValueError("a schema nested too deeply")
        for _ in range(children):
            element = next(following, {})
            name = (*path, element[4].decode())
            many = repeated or element.get(3) == _REPEATED
            if element.get(5):
                walk(int(element[5]), name, many)
            else:
                width = _WIDTHS.get(element[1], max(8, int(element.get(2, 0))))
                found.append((".".join(name), width, many))

    walk(int(elements[0][5]), (), False)
    return found


class _Reader:
    """Thrift's compact protocol: structures as dictionaries by field number."""

    def __init__(self, content: bytes):
        self.content, self.place = content, 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        fields: dict[int, Any] = {}
        number = 0
        while head := self.take(1)[0]:
            number = number + (head >> 4) if head >> 4 else self.integer()
            kind = head & 15
            fields[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self.value(kind, depth + 1)
        return fields

    def value(self, kind: int, depth: int) -> Any:
        if depth > _DEEPEST:
            raise ValueError("a footer nested too deeply")
        if kind in _INTEGERS:
            return self.integer()
        if kind == _BINARY:
            return self.take(self.varint())
        if kind == _STRUCT:
            return self.struct(depth)
        if kind in (_BYTE, _TRUE, _FALSE):
            return self.take(1)[0]
        if kind == _DOUBLE:
            return self.take(8)
        if kind in (_LIST, _SET):
            head = self.take(1)[0]
            count, kinds = head >> 4 if head >> 4 < 15 else self.varint(), (head & 15,)
        elif kind == _MAP:
            count = self.varint()
            head = self.take(1)[0] if count else 0
            kinds = (head >> 4, head & 15)
        else:
            raise ValueError(f"a field of unknown kind {kind} in its footer")
        self.require(count)
        return [self.value(one, depth + 1) for _ in range(count) for one in kinds]

    def integer(self) -> int:
        coded = self.varint()
        return (coded >> 1) ^ -(coded & 1)

    def varint(self) -> int:
        found = 0
        for shift in range(0, 70, 7):
            byte = self.take(1)[0]
            found |= (byte & 127) << shift
            if byte < 128:
                return found
        raise ValueError("a number without end in its footer")

    def require(self, count: int) -> None:
        """Nothing takes less than a byte, so that no count can ask for more than there is."""
        if count > len(self.content) - self.place:
            raise ValueError("a footer that ends too early")

    def take(self, count: int) -> bytes:
        self.require(count)
        self.place += count
        return self.content[self.place - count : self.place]
