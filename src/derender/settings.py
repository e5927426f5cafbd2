"""The base of every settings class: frozen, strict about names and types; dotted names; values as JSON."""

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict
from pydantic_core import to_jsonable_python

from derender.storage.places import suggestion


class Settings(BaseModel):
    """Immutable settings; an unknown name or a value of the wrong type is an error, never ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)


def plain(value: Any) -> Any:
    """Dataclasses, arrays, tensors and paths as what JSON can hold; NaN and infinity become null."""

    def listed(one: Any) -> Any:
        if isinstance(one, Mapping):
            return dict(one)
        return one.tolist() if hasattr(one, "tolist") else list(one)

    return to_jsonable_python(value, inf_nan_mode="null", fallback=listed)


def leaves_of(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted name."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        leaves |= leaves_of(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return leaves


def full_key(key: str, names: Iterable[str]) -> str:
    """The dotted name that a key stands for."""
    if key in names:
        return key
    ending = [name for name in names if f".{name}".endswith(f".{key}")]
    if len(ending) == 1:
        return ending[0]
    if ending:
        raise ValueError(f"{key!r} could mean {' or '.join(ending)}: write it in full")
    guess = suggestion(key, names) or suggestion(
        key.rsplit(".", 1)[-1], [name.rsplit(".", 1)[-1] for name in names]
    )
    raise ValueError(f"unknown setting {key!r}{guess}: 'derender train --dry-run' lists all of them")
