"""Old name of ``Memory.recall_value``."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from derender.evaluation.memory import Memory

T = TypeVar("T")


def recall_value(
    memory: Memory, what: str, inputs: Mapping[str, Any], kind: type[T], make: Callable[[], T]
) -> T:
    """See ``Memory.recall_value``."""
    return memory.recall_value(what, inputs, kind, make)
