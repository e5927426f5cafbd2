"""The base of every settings class: frozen, strict about names and types; values as JSON."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict
from pydantic_core import to_jsonable_python

ONE_OR_MANY = BeforeValidator(lambda one: (one,) if isinstance(one, str) else one)
Names = Annotated[tuple[str, ...], ONE_OR_MANY]


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
