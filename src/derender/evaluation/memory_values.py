"""Results that are dataclasses as what a memory keeps: arrays, and everything else as one line of JSON.

The way back goes by the annotations of the dataclass. A file whose fields are no longer those of the class is
as good as none: the result is made again. Leaves out any class whose fields are more than numbers, texts,
arrays, tuples, mappings of these, other such dataclasses, and None.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from derender.evaluation.memory import Arrays, Memory

T = TypeVar("T")


def recall_value(
    memory: Memory, what: str, inputs: Mapping[str, Any], kind: type[T], make: Callable[[], T]
) -> T:
    """The dataclass that ``make`` gives, from the memory if the very same inputs made it before.

    Args:
        memory: where results are kept.
        what, inputs: as of ``Memory.recall``.
        kind: the class of the result.
        make: computes it.
    """
    fields = [field.name for field in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
    keyed = {**inputs, "fields": fields}
    stored = memory.recall(what, keyed, lambda: packed(make()))
    return unpacked(kind, stored)


def packed(value: Any) -> Arrays:
    """A dataclass as arrays by name; ``value`` holds what is no array."""
    arrays: Arrays = {}
    told = _told(value, "", arrays)
    return {"value": np.array(json.dumps(told, default=lambda number: number.item())), **arrays}


def unpacked(kind: type[T], arrays: Mapping[str, np.ndarray]) -> T:
    """What ``packed`` took."""
    return _built(kind, json.loads(str(arrays["value"])), arrays)


def _told(value: Any, path: str, arrays: Arrays) -> Any:
    """A value as JSON; its arrays go into ``arrays`` by their place, which stands where they were."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return {"array": path}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: _told(getattr(value, field.name), f"{path}.{field.name}", arrays)
            for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {name: _told(one, f"{path}.{name}", arrays) for name, one in value.items()}
    if isinstance(value, tuple | list):
        return [_told(one, f"{path}.{place}", arrays) for place, one in enumerate(value)]
    return value


def _built(kind: Any, told: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if isinstance(told, dict) and set(told) == {"array"}:
        return arrays[told["array"]]
    if told is None:
        return None
    classes = [
        one for one in (kind, *get_args(kind)) if isinstance(one, type) and dataclasses.is_dataclass(one)
    ]
    if classes:
        hints = get_type_hints(classes[0])
        return classes[0](**{name: _built(hints[name], one, arrays) for name, one in told.items()})
    return tuple(told) if isinstance(told, list) else told
