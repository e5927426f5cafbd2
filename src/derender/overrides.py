"""Settings changed by ``key=value``, as ``--set`` and plans write them, and checked, with one clear error."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import reduce
from operator import getitem
from reprlib import Repr
from typing import Any, TypeVar

from pydantic import ValidationError

from derender.settings import Settings
from derender.storage.bounded import parse_yaml
from derender.storage.places import suggestion

LISTED = 40  # of so many settings at most an unknown one is told all names
SHORT = Repr()
SHORT.maxstring = SHORT.maxother = 200  # a few lines of YAML can stand for gigabytes of text

Config = TypeVar("Config", bound=Settings)


def with_changes(config: Config, overrides: Iterable[str] = (), **explicit: Any) -> Config:
    """The same kind of settings with ``key=value`` overrides, then explicit dotted keys.

    Keys are dotted (``optimiser.learning_rate``); a unique last part may stand alone. Values are read as
    YAML. In ``explicit`` dots are written as double underscores and None means not given.

    Raises:
        ValueError: unknown key (names the nearest, or all), or a value that does not fit.
    """
    tree = config.model_dump(mode="json")
    names, changes = settings_by_name(tree), []
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ValueError(f"cannot read {override!r}: write key=value, such as {next(iter(names))}=...")
        changes.append((key.strip(), _read_value(text)))
    changes += [(key.replace("__", "."), value) for key, value in explicit.items() if value is not None]
    for key, value in changes:
        *parents, last = _full_key(key, tree, names).split(".")
        try:
            reduce(getitem, parents, tree)[last] = value
        except (TypeError, KeyError) as error:  # a whole group was replaced by another value before
            raise ValueError(f"setting {key!r}: {parents[0]} was set as a whole before; name one") from error
    return checked(tree, type(config))


def checked(tree: Mapping[str, Any], kind: type[Config]) -> Config:
    """Settings of plain values (from YAML or JSON), or one clear error."""
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key, why = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            known = settings_by_name(kind().model_dump(mode="json"))
            raise ValueError(f"unknown setting {key!r}{suggestion(key, known)}") from error
        got = "" if "got" in why else f", got {SHORT.repr(first['input'])}"
        raise ValueError(f"setting {key!r}: {why}{got}") from error


def settings_by_name(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted name."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        leaves |= settings_by_name(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return leaves


def _read_value(text: str) -> Any:
    """YAML, and numbers such as 1e-4 that YAML 1.1 takes for words."""
    try:
        value = parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"cannot read the value {text!r}: write a number, word, true or [a, b]") from error
    if isinstance(value, str):
        with suppress(ValueError):
            return float(value)
    return value


def _full_key(key: str, tree: Mapping[str, Any], names: Mapping[str, Any]) -> str:
    """The dotted name that a key stands for."""
    with suppress(LookupError, TypeError):
        reduce(getitem, key.split("."), tree)
        return key
    ending = [name for name in names if f".{name}".endswith(f".{key}")]
    if len(ending) == 1:
        return ending[0]
    if ending:
        raise ValueError(f"{key!r} could mean {' or '.join(ending)}: write it in full")
    last, *lasts = (name.rsplit(".", 1)[-1] for name in (key, *names))
    guess = suggestion(key, names) or suggestion(last, lasts)
    known = f"there are {', '.join(names)}" if len(names) <= LISTED else "--dry-run lists all of them"
    raise ValueError(f"unknown setting {key!r}{guess}: {known}")
