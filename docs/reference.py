"""Pages written from the code while Sphinx reads them: every command, every setting, every bundled model.

A page asks for one with a line ``<!-- commands -->``, ``<!-- settings -->`` or ``<!-- models -->``.
"""

import ast
import inspect
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from io import StringIO
from typing import Any

import typer
from pydantic import BaseModel

from derender.cli import app as commands


def fill(_: Any, __: str, source: list[str]) -> None:
    """Replace the marks of a page that is about to be parsed."""
    for mark, write in {"commands": command_pages, "settings": setting_tables}.items():
        if f"<!-- {mark} -->" in source[0]:
            source[0] = source[0].replace(f"<!-- {mark} -->", "\n".join(write()))


def all_commands(group: Any = None, before: str = "derender") -> Iterator[tuple[str, Any]]:
    """Every command that is not hidden, by its full name."""
    for name, command in (group or typer.main.get_command(commands)).commands.items():
        full = f"{before} {name}"
        if hasattr(command, "commands"):
            yield from all_commands(command, full)
        elif not command.hidden:
            yield full, command


Options = dict[str, tuple[str, str, str]]
"""Of one command: all names, meaning and default by first name."""

SHARED = 4
"""An option that means the same in so many commands is explained once, above them."""


def command_pages() -> Iterator[str]:
    """Shared options, then for each command: what it does, its usage, an example, its own options."""
    rows = {name: dict(map(option_row, shown(command))) for name, command in all_commands()}
    count = Counter((option, *row[:2]) for one in rows.values() for option, row in one.items())
    shared: dict[str, tuple[str, str]] = {}
    for (option, *row), times in count.most_common():
        if times >= SHARED:
            shared.setdefault(option, (row[0], row[1]))
    defaults = {option: usual_default(option, row, rows.values()) for option, row in shared.items()}
    yield from ("## Shared options\n", HEAD)
    yield from (f"| {names} | {text} | {defaults[option]} |" for option, (names, text) in shared.items())
    yield ""
    for name, command in all_commands():
        yield f"## {name}\n\n{clean(command.help or '')}\n"
        arguments = " ".join(
            f"[{one.metavar}]" for one in shown(command) if one.param_type_name == "argument"
        )
        example = re.sub(r"^Example: ", "", command.epilog or "")
        yield f"```sh\n{name} {arguments} [OPTIONS]\n{f'{example}   # example' if example else ''}\n```\n"
        own = [row for option, row in rows[name].items() if shared.get(option) != row[:2]]
        yield from (HEAD, *(f"| {' | '.join(row)} |" for row in own), "") if own else ()
        others = [
            f"`{option}`" + (f" (default {row[2] or 'none'})" if row[2] != defaults[option] else "")
            for option, row in rows[name].items()
            if shared.get(option) == row[:2]
        ]
        yield f"Shared: {', '.join(others)}.\n" if others else ""


def usual_default(option: str, row: tuple[str, str], commands: Iterable[Options]) -> str:
    """The default that most commands give an option of these names and this meaning."""
    same = [one[option][2] for one in commands if option in one and one[option][:2] == row]
    return Counter(same).most_common(1)[0][0]


HEAD = "| option | meaning | default |\n| --- | --- | --- |"


def shown(command: Any) -> list[Any]:
    """Arguments and options that a user is told of."""
    return [one for one in command.params if not getattr(one, "hidden", False) and one.name != "help"]


def option_row(one: Any) -> tuple[str, tuple[str, str, str]]:
    """An option's first name, and its row: all names, meaning, default."""
    option = one.param_type_name == "option"
    names = ", ".join(one.opts + one.secondary_opts) if option else one.metavar or one.name.upper()
    default = one.default() if callable(one.default) else one.default
    empty = default is None or default is False or default == ()
    row = f"`{names}`", clean(one.help or ""), "" if empty else f"`{default}`"
    return (one.opts[0] if option else names), row


def clean(text: str) -> str:
    """Help as one line of Markdown."""
    text = re.sub(r"\[/?(?:bold|dim|italic|cyan)\]", "", text)
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").strip()


def setting_tables() -> Iterator[str]:
    """A table for each class of settings: name, default, range or choice, the comment beside it."""
    from derender.evaluation.segmenters import SegmentSettings
    from derender.training.config import PRESETS, FinetuneConfig, TrainConfig
    from derender.training.distillation import RefineConfig
    from derender.training.unets import UNetSettings

    wanted = {
        "derender train": TrainConfig, "derender finetune": FinetuneConfig, "derender refine": RefineConfig,
        "derender unet": UNetSettings, "derender evaluate segment": SegmentSettings,
    }  # fmt: skip
    seen: set[str] = set()
    for command, kind in wanted.items():
        yield f"## `{command}`\n\nOne row per key of `--set KEY=VALUE`.\n"
        yield from rows_of(kind(), "", seen)
        yield ""
    yield "## Presets\n\nWhat each preset changes.\n\n| preset | key | value |\n| --- | --- | --- |"
    plain = flat(TrainConfig())
    for name, preset in PRESETS.items():
        for key, value in flat(preset).items():
            if value != plain[key] and key != "preset":
                yield f"| `{name}` | `{key}` | `{value}` |"


def flat(settings: BaseModel, before: str = "") -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        result |= flat(value, f"{before}{name}.") if isinstance(value, BaseModel) else {before + name: value}
    return result


def rows_of(settings: BaseModel, before: str, seen: set[str]) -> Iterator[str]:
    """Rows of a class and of the classes inside it; what another table has is left out."""
    if not before:
        yield "| key | default | meaning |\n| --- | --- | --- |"
    comments = comments_of(type(settings))
    for name in type(settings).model_fields:
        value, key = getattr(settings, name), f"{before}{name}"
        if isinstance(value, BaseModel):
            yield from rows_of(value, f"{key}.", seen)
        elif f"{key}={value}" not in seen:
            seen.add(f"{key}={value}")
            yield f"| `{key}` | `{value}` | {clean(comments.get(name, ''))} |"


def comments_of(kind: type) -> dict[str, str]:
    """The comment on the line of each field, of the class and of those it is made from."""
    result: dict[str, str] = {}
    for one in reversed(
        [base for base in kind.__mro__ if issubclass(base, BaseModel) and base is not BaseModel]
    ):
        source = inspect.getsource(one)
        lines = {
            token.start[0]: token.string.lstrip("# ")
            for token in tokenize.generate_tokens(StringIO(inspect.cleandoc("\n" + source)).readline)
            if token.type == tokenize.COMMENT and "fmt:" not in token.string
        }
        for node in ast.parse(inspect.cleandoc("\n" + source)).body[0].body:  # type: ignore[attr-defined]
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                text = next(
                    (
                        lines[n]
                        for n in range(node.lineno, (node.end_lineno or node.lineno) + 1)
                        if n in lines
                    ),
                    "",
                )
                result[node.target.id] = text
    return result
