"""Commands, and options that several of them share, as one parameter: a dataclass whose fields are options.

A command that asks for such a dataclass is shown to typer with the fields in its place, and called with the
value. A field of a library's own dataclass says in its metadata what typer shows (``report/opening.py``).
Leaves out which options there are.
"""

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any

import typer


def command(name: str, example: str) -> Callable[[Callable[..., None]], Any]:
    """Decorate a ``gathered`` command: it gets ``register``, which puts it under its name into an app."""

    def decorated(function: Callable[..., None]) -> Callable[..., None]:
        run: Any = gathered(function)
        run.register = lambda app: app.command(name, epilog=f"Example: derender {example}")(run)
        return run

    return decorated


def gathered(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the fields of its dataclass parameters in their place, all given by name."""
    groups: dict[str, type] = {}
    shown: list[inspect.Parameter] = []

    def show(name: str, annotation: Any, default: Any) -> None:
        how = {"default": default, "annotation": annotation}
        shown.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, **how))

    for parameter in inspect.signature(command).parameters.values():
        if not (isinstance(parameter.annotation, type) and is_dataclass(parameter.annotation)):
            show(parameter.name, parameter.annotation, parameter.default)
            continue
        groups[parameter.name] = parameter.annotation
        for field in fields(parameter.annotation):
            option = Annotated[field.type, typer.Option(**field.metadata)] if field.metadata else field.type
            show(field.name, option, inspect.Parameter.empty if field.default is MISSING else field.default)

    @functools.wraps(command)
    def run(**given: Any) -> None:
        taken = {
            name: group(**{field.name: given.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        command(**given, **taken)

    run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    return run
