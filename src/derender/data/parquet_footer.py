"""The footer of a parquet file as plain numbers, read without a library that could end the process over it.

Source: Thrift's compact protocol and parquet-format's ``parquet.thrift``. pyarrow 26 looks at a damaged
footer with C++ exceptions that nobody catches. Leaves out what nobody here asks for: it is skipped, not
checked.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BufferedIOBase
from typing import Any

MAGIC = b"PAR1"
DEEPEST = 32
_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 11, 12
_INTEGERS = (4, 5, 6)
_OPTIONAL, _REPEATED = 1, 2
BOOLEAN, INT32, INT64, INT96, FLOAT, DOUBLE, BYTES, FIXED = range(8)


@dataclass(frozen=True)
class Leaf:
    """A column as the schema has it.

    Attributes:
        name: its path, with dots.
        kind: ``BOOLEAN`` to ``FIXED``.
        length: of a fixed number of bytes, else 0.
        repeated: whether a row may hold several values.
    """

    name: str
    kind: int
    length: int
    repeated: bool


@dataclass(frozen=True)
class Chunk:
    """What is said of one column in one group of rows: how many values, and bytes as stored and unpacked."""

    values: int
    compressed: int
    uncompressed: int


@dataclass(frozen=True)
class Group:
    """A group of rows: their number, and a chunk for every column."""

    rows: int
    chunks: Sequence[Chunk]


@dataclass(frozen=True)
class Footer:
    """What a file says of itself."""

    rows: int
    leaves: Sequence[Leaf]
    groups: Sequence[Group]


def read_footer(file: BufferedIOBase, size: int) -> Footer:
    """The footer of a file of ``size`` bytes.

    Raises:
        OSError: there is none.
        ValueError: it is damaged, with what is wrong in words.
    """
    file.seek(max(0, size - 8))
    end = file.read(8)
    length = int.from_bytes(end[:4], "little")
    if len(end) < 8 or end[4:] != MAGIC or length + 12 > size:
        raise OSError("no parquet footer at its end")
    file.seek(size - 8 - length)
    try:
        said = _Reader(file.read(length)).struct()
        leaves = _leaves(said[2])
        return Footer(int(said[3]), leaves, [_group(group) for group in said[4]])
    except (LookupError, TypeError, AttributeError, UnicodeDecodeError) as error:
        raise ValueError("a footer that is none") from error


def _group(said: dict[int, Any]) -> Group:
    chunks = []
    for chunk in said[1]:
        if 8 in chunk or 9 in chunk:
            raise ValueError("encrypted columns")
        told = chunk[3]
        chunks.append(Chunk(int(told[5]), int(told[7]), int(told[6])))
    return Group(int(said[3]), chunks)


def _leaves(elements: Sequence[dict[int, Any]]) -> list[Leaf]:
    """The schema's tree stands in the order of a walk through it; its root is no column."""
    found: list[Leaf] = []
    place = 1

    def walk(children: int, path: tuple[str, ...], repeated: bool) -> None:
        nonlocal place
        if len(path) > DEEPEST:
            raise ValueError("a schema nested too deeply")
        for _ in range(children):
            element = elements[place]
            place += 1
            name = (*path, element[4].decode())
            many = repeated or element.get(3) == _REPEATED
            if element.get(5):
                walk(int(element[5]), name, many)
            else:
                found.append(Leaf(".".join(name), int(element[1]), int(element.get(2, 0)), many))

    walk(int(elements[0][5]), (), False)
    return found


class _Reader:
    """Thrift's compact protocol: structures as dictionaries by field number."""

    def __init__(self, content: bytes):
        self.content, self.place = content, 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        fields: dict[int, Any] = {}
        number = 0
        while True:
            head = self.byte()
            kind = head & 15
            if kind == _STOP:
                return fields
            number = number + (head >> 4) if head >> 4 else self.integer()
            fields[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self.value(kind, depth + 1)

    def value(self, kind: int, depth: int) -> Any:
        if depth > DEEPEST:
            raise ValueError("a footer nested too deeply")
        if kind in _INTEGERS:
            return self.integer()
        if kind == _BINARY:
            return self.take(self.varint())
        if kind in (_LIST, _SET):
            return self.items(depth)
        if kind == _STRUCT:
            return self.struct(depth)
        if kind in (_BYTE, _TRUE, _FALSE):
            return self.byte()
        if kind == _DOUBLE:
            return self.take(8)
        if kind == _MAP:
            return self.pairs(depth)
        raise ValueError(f"a field of unknown kind {kind} in its footer")

    def items(self, depth: int) -> list[Any]:
        head = self.byte()
        count = head >> 4 if head >> 4 < 15 else self.varint()
        self.room(count)
        return [self.value(head & 15, depth + 1) for _ in range(count)]

    def pairs(self, depth: int) -> list[tuple[Any, Any]]:
        count = self.varint()
        kinds = self.byte() if count else 0
        self.room(count)
        return [(self.value(kinds >> 4, depth + 1), self.value(kinds & 15, depth + 1)) for _ in range(count)]

    def integer(self) -> int:
        coded = self.varint()
        return (coded >> 1) ^ -(coded & 1)

    def varint(self) -> int:
        found = 0
        for shift in range(0, 70, 7):
            byte = self.byte()
            found |= (byte & 127) << shift
            if byte < 128:
                return found
        raise ValueError("a number without end in its footer")

    def room(self, count: int) -> None:
        """Nothing takes less than a byte, so that no count can ask for more than there is."""
        if count > len(self.content) - self.place:
            raise ValueError("a footer that ends too early")

    def take(self, count: int) -> bytes:
        self.room(count)
        self.place += count
        return self.content[self.place - count : self.place]

    def byte(self) -> int:
        return self.take(1)[0]
