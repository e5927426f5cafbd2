"""Shared options: a command is shown the fields of a dataclass, and called with its value."""

import inspect
from dataclasses import dataclass

from derender.cli.gathered import gathered


@dataclass(frozen=True)
class Shared:
    name: str
    often: int = 2


def test_fields_become_options_and_come_back_as_one_value():
    seen = []

    @gathered
    def command(shared: Shared, loud: bool = False) -> None:
        """Say it."""
        seen.append((shared, loud))

    shown = inspect.signature(command).parameters
    assert list(shown) == ["name", "often", "loud"] and command.__doc__ == "Say it."
    assert shown["name"].default is inspect.Parameter.empty and shown["often"].default == 2
    assert {name: one.annotation for name, one in shown.items()} == {"name": str, "often": int, "loud": bool}
    command(name="ann", often=3, loud=True)
    assert seen == [(Shared("ann", 3), True)]
