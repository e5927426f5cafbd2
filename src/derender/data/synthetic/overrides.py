"""Settings of generated pictures changed by ``key=value`` text, as the command line takes it."""

from collections.abc import Iterable
from typing import Any, TypeVar

import yaml
from pydantic import ValidationError

from derender.settings import Settings

Kind = TypeVar("Kind", bound=Settings)


def changed(settings: Kind, overrides: Iterable[str]) -> Kind:
    """The settings with changes such as ``light.yaw_deg=[-60,60]``; keys are dotted, values are YAML.

    Raises:
        ValueError: text that is not key=value, an unknown key (the known ones are listed), or a bad value.
    """
    tree = settings.model_dump(mode="python")
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals:
            raise ValueError(f"cannot read {override!r}: write key=value, for example light.yaw_deg=[-60,60]")
        *parents, last = key.strip().split(".")
        branch: Any = tree
        for parent in parents:
            branch = branch.get(parent) if isinstance(branch, dict) else None
        if not isinstance(branch, dict) or last not in branch:
            raise ValueError(f"unknown setting {key.strip()!r}; there are {', '.join(_names(tree))}")
        try:
            branch[last] = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise ValueError(f"cannot read the value {text!r} of {key.strip()}") from error
    try:
        return type(settings).model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        what = first["msg"].removeprefix("Value error, ")
        raise ValueError(f"setting {where}: {what}" if where else what) from error


def _names(tree: dict[str, Any], prefix: str = "") -> list[str]:
    names: list[str] = []
    for key, value in tree.items():
        names += _names(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]
    return names
