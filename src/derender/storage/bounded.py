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
FILE_LIMIT_BYTES = 512 << 20  # of images and members of archives: bounds what a zip bomb can unpack to
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


def table_beside(module: str, name: str) -> Any:
    """The plain values of a YAML file of this package, which lies beside a module's ``__file__``."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # eight times as fast, where it is built
    return loader(Path(module).with_name(name).read_text(encoding="utf-8")).get_single_data()


def parse_json(content: str | bytes, kind: Any) -> Any:
    """JSON text as a value of ``kind``; a ValueError where it is none, or nested deeper than about 200."""
    return TypeAdapter(kind).validate_json(content, strict=True)


def _require_small(text: str) -> None:
    """Raise ValueError where a YAML text has too many values or levels, as often as aliases repeat them."""
    within: list[Any] = [(None, 0, 0)]  # of each open list or mapping: anchor, values and levels so far
    sizes: dict[str | None, tuple[int, int]] = {}  # values and levels by anchor
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            within.append((event.anchor, 1, 0))
        elif isinstance(event, yaml.NodeEvent | yaml.CollectionEndEvent):
            anchor, values, levels = getattr(event, "anchor", None), 1, 1
            if isinstance(event, yaml.AliasEvent):
                if anchor not in sizes:
                    raise ValueError(f"alias {anchor!r} stands for no value before it")
                values, levels = sizes[anchor]
            elif isinstance(event, yaml.CollectionEndEvent):
                anchor, values, levels = within.pop()
                levels += 1
            elif isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_VALUE:
                raise ValueError(f"a value of more than {LONGEST_VALUE:,} characters")
            sizes[anchor] = values, levels
            around, before, deepest = within.pop()
            within.append((around, before + values, max(deepest, levels)))
        if within[-1][1] > MOST_VALUES or len(within) + within[-1][2] > DEEPEST + 1:
            raise ValueError(f"more than {DEEPEST} levels or {MOST_VALUES:,} values")


def parse_yaml(text: str) -> Any:
    """The plain values of a YAML text; a ValueError where it is none or too large, aliases unfolded."""
    if len(text) > YAML_LIMIT:
        raise ValueError(f"{len(text):,} characters of YAML are more than {YAML_LIMIT:,}")
    try:
        _require_small(text)
        return yaml.safe_load(text)
    except (yaml.YAMLError, LookupError, AttributeError, TypeError, ArithmeticError) as error:
        raise ValueError(first_line(error)) from error


def first_line(error: Exception) -> str:
    """Of its message, and of a ValidationError its first finding."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        return f"{where}: {first['msg']}" if where else first["msg"]
    return str(error).splitlines()[0] if str(error) else type(error).__name__
