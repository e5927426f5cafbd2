"""The footer of a parquet file, held against the file before a library reads it or takes memory for it.

Readers reserve memory for as many rows as the footer names: one changed byte of a file of 2 kB can ask for
18 GB. And pyarrow 26 looks at a damaged footer with C++ exceptions that end the process. So the footer is
read here as plain numbers (Thrift's compact protocol, parquet-format's ``parquet.thrift``) and compared
with itself and with the size of the file. Leaves out the pages behind the footer, and all that is not asked
for: it is skipped.
"""

from collections.abc import Sequence
from io import BufferedIOBase
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import pyarrow as pa

ALWAYS_ALLOWED_BYTES = 512 * 2**20
MOST_EXPANSION = 1000
"""Of features that are all the same some files expand hundreds of times, of real ones not ten times."""

_MAGIC = b"PAR1"
_DEEPEST = 32
_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 11, 12
_INTEGERS = (4, 5, 6)
_REPEATED = 2
_WIDTHS = {
    0: 1,
    1: 4,
    3: 12,
    4: 4,
}  # bytes of a value by physical type; else 8 or more


class Leaf(NamedTuple):
    """A column as the schema has it: its path with dots, its physical type, its length in bytes if that is
    fixed (else 0), and whether a row may hold several values."""

    name: str
    kind: int
    length: int
    repeated: bool


class Chunk(NamedTuple):
    """One column in one group of rows: how many values, and its bytes as stored and unpacked."""

    values: int
    compressed: int
    uncompressed: int


class Group(NamedTuple):
    """A group of rows: their number, and a chunk for every column."""

    rows: int
    chunks: Sequence[Chunk]


class Footer(NamedTuple):
    """What a file claims."""

    rows: int
    leaves: Sequence[Leaf]
    groups: Sequence[Group]


def checked_footer(file: BufferedIOBase, size: int) -> Footer:
    """The footer of a file of ``size`` bytes, if all that it claims can be.

    Raises:
        OSError: there is none.
        ValueError: what is damaged or cannot be, in words: numbers of rows and values that contradict each
            other, sizes beyond the file's, and values that would take more than 512 MiB and more than 1000
            times the size of the file.
    """
    footer = read_footer(file, size)
    compressed = taken = 0
    for group in footer.groups:
        if group.rows < 0:
            raise ValueError(f"{group.rows:,} rows")
        if len(group.chunks) != len(footer.leaves):
            raise ValueError(f"{len(group.chunks)} columns where the schema has {len(footer.leaves)}")
        for leaf, chunk in zip(footer.leaves, group.chunks, strict=True):
            fits = chunk.values >= group.rows if leaf.repeated else chunk.values == group.rows
            if not fits:
                raise ValueError(f"{chunk.values:,} values of {leaf.name} in {group.rows:,} rows")
            if min(chunk.compressed, chunk.uncompressed) < 0:
                raise ValueError(f"a size of {leaf.name} below zero")
            compressed += chunk.compressed
            taken += max(chunk.values * _WIDTHS.get(leaf.kind, max(8, leaf.length)), chunk.uncompressed)
    rows = sum(group.rows for group in footer.groups)
    if rows != footer.rows:
        raise ValueError(f"{footer.rows:,} rows, its parts have {rows:,}")
    if compressed > size:
        raise ValueError(f"{compressed:,} bytes of columns in a file of {size:,}")
    _bounded(taken, size)
    return footer


def check_lists(footer: Footer, schema: "pa.Schema", size: int) -> None:
    """ValueError if lists of a fixed length, of which a footer counts nothing, would take too much."""
    import pyarrow as pa

    widest = [kind.list_size for kind in schema.types if pa.types.is_fixed_size_list(kind)]
    _bounded(4 * footer.rows * sum(widest), size)


def _bounded(taken: int, size: int) -> None:
    if taken > max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * size):
        raise ValueError(f"{taken:,} bytes of values in a file of {size:,}")


def read_footer(file: BufferedIOBase, size: int) -> Footer:
    """The footer as it stands there; the errors of ``checked_footer``."""
    file.seek(max(0, size - 8))
    end = file.read(8)
    length = int.from_bytes(end[:4], "little")
    if len(end) < 8 or end[4:] != _MAGIC or length + 12 > size:
        raise OSError("no parquet footer at its end")
    file.seek(size - 8 - length)
    try:
        fields = _Reader(file.read(length)).struct()
        return Footer(int(fields[3]), _leaves(fields[2]), [_group(group) for group in fields[4]])
    except (LookupError, TypeError, AttributeError, UnicodeDecodeError) as error:
        raise ValueError("a footer that is none") from error


def _group(fields: dict[int, Any]) -> Group:
    if any(8 in chunk or 9 in chunk for chunk in fields[1]):
        raise ValueError("encrypted columns")
    chunks = [chunk[3] for chunk in fields[1]]
    return Group(int(fields[3]), [Chunk(int(one[5]), int(one[7]), int(one[6])) for one in chunks])


def _leaves(elements: Sequence[dict[int, Any]]) -> list[Leaf]:
    """The schema's tree stands in the order of a walk through it; its root is no column."""
    found: list[Leaf] = []
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
        while (head := self.byte()) & 15 != _STOP:
            kind = head & 15
            number = number + (head >> 4) if head >> 4 else self.integer()
            fields[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self.value(kind, depth + 1)
        return fields

    def value(self, kind: int, depth: int) -> Any:
        if depth > _DEEPEST:
            raise ValueError("a footer nested too deeply")
        if kind in _INTEGERS:
            return self.integer()
        if kind == _BINARY:
            return self.take(self.varint())
        if kind in (_LIST, _SET):
            head = self.byte()
            count = head >> 4 if head >> 4 < 15 else self.varint()
            return self.items(count, (head & 15,), depth)
        if kind == _MAP:
            count = self.varint()
            kinds = self.byte() if count else 0
            return self.items(count, (kinds >> 4, kinds & 15), depth)
        if kind == _STRUCT:
            return self.struct(depth)
        if kind in (_BYTE, _TRUE, _FALSE):
            return self.byte()
        if kind == _DOUBLE:
            return self.take(8)
        raise ValueError(f"a field of unknown kind {kind} in its footer")

    def items(self, count: int, kinds: tuple[int, ...], depth: int) -> list[Any]:
        """So many times a value of each kind, one after the other."""
        self.room(count)
        return [self.value(kind, depth + 1) for _ in range(count) for kind in kinds]

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
