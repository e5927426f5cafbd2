"""Text files of runs and models, whoever wrote them: bounded in size and depth, and of the expected type.

A regular file's size is compared with a limit before any of it is read. JSON goes through pydantic, which
bounds depth and digits; YAML is measured, aliases unfolded, before anything is built of it. Every refusal is
one sentence. Leaves out tensors (``tensors.py``) and images (``data/image.py``).
"""

import stat
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

TEXT_LIMIT_BYTES = 8 << 20
LINES_LIMIT_BYTES = 256 << 20
YAML_LIMIT, MOST_VALUES, DEEPEST, LONGEST_VALUE = 1 << 18, 20_000, 50, 10_000
"""Of YAML: characters, values with aliases unfolded, levels, and characters of one value."""


def require_regular(path: Path, limit: int) -> int:
    """The size in bytes of a regular file; a ValueError where it is something else, or above ``limit``."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):  # a pipe may never end, a device never does
        raise ValueError("not a regular file")
    if status.st_size > limit:
        raise ValueError(f"file of {status.st_size >> 20:,} MiB is larger than {limit >> 20:,} MiB")
    return status.st_size


def read_bounded(path: Path, limit: int = TEXT_LIMIT_BYTES) -> bytes:
    """A file's content; ValueError when it is no regular file or larger than ``limit`` bytes."""
    size = require_regular(path, limit)
    with path.open("rb") as stream:
        content = stream.read(size + 1)
    if len(content) > size:
        raise ValueError("the file grew while it was read")
    return content


def read_text(path: Path, limit: int = TEXT_LIMIT_BYTES) -> str:
    """As ``read_bounded``, UTF-8."""
    return read_bounded(path, limit).decode("utf-8")


def read_json(file: Path, kind: Any, otherwise: str = "copy or train the model again") -> Any:
    """A JSON file as a value of ``kind``, any type that pydantic knows, strictly.

    Raises:
        OSError: there is no such file.
        ValueError: it cannot be read or is of another kind: FILE is damaged or of a newer version (why).
    """
    try:
        return parse_json(read_bounded(file), kind)
    except ValueError as error:
        why = f"is damaged or of a newer version ({first_line(error)})"
        raise ValueError(f"{file} {why}: {otherwise}") from error


def parse_json(content: str | bytes, kind: Any) -> Any:
    """JSON text as a value of ``kind``; a ValueError where it is none, or nested deeper than about 200."""
    return TypeAdapter(kind).validate_json(content, strict=True)


class _Measuring(yaml.SafeLoader):
    """Composes nodes and knows of each the values and levels in it, as often as aliases repeat them."""

    def __init__(self, text: str):
        super().__init__(text)
        self.sizes: dict[int, tuple[int, int]] = {}
        self.level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        alias, self.level = self.check_event(yaml.AliasEvent), self.level + 1
        if self.level > DEEPEST:
            raise ValueError(f"more than {DEEPEST} levels")
        node = super().compose_node(parent, index)
        self.level -= 1
        if id(node) not in self.sizes:
            if alias:
                raise ValueError("a value stands inside itself")
            content = node.value if isinstance(node, yaml.CollectionNode) else ()
            pairs = (pair if isinstance(pair, tuple) else (pair,) for pair in content)
            within = [self.sizes[id(one)] for pair in pairs for one in pair]
            self.sizes[id(node)] = values, levels = (
                1 + sum(count for count, _ in within),
                1 + max((depth for _, depth in within), default=0),
            )
            if max(values, len(self.sizes)) > MOST_VALUES or levels > DEEPEST:
                raise ValueError(f"more than {MOST_VALUES:,} values or {DEEPEST} levels")
            if isinstance(node, yaml.ScalarNode) and len(node.value) > LONGEST_VALUE:
                raise ValueError(f"a value of more than {LONGEST_VALUE:,} characters")
        return node


def parse_yaml(text: str) -> Any:
    """The plain values of a YAML text; a ValueError where it is none or too large, aliases unfolded."""
    if len(text) > YAML_LIMIT:
        raise ValueError(f"{len(text):,} characters of YAML are more than {YAML_LIMIT:,}")
    try:
        loader = _Measuring(text)
        node = loader.get_single_node()
        return None if node is None else loader.construct_document(node)
    except (yaml.YAMLError, LookupError, AttributeError, TypeError, ArithmeticError) as error:
        raise ValueError(first_line(error)) from error


def first_line(error: Exception) -> str:
    """Of its message, and of a ValidationError its first finding."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        return f"{where}: {first['msg']}" if where else first["msg"]
    return str(error).splitlines()[0] if str(error) else type(error).__name__
