"""What all commands share: where words, numbers and progress go.

Results go to standard output, everything else to standard error, so that a pipe carries results only.
Leaves out what any single command does.
"""

import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from math import inf
from typing import TYPE_CHECKING, Any

from rich import progress as bars
from rich.console import Console
from rich.table import Table
from rich.text import Text

from derender.storage.atomic import DamageNoticed, write_whole

if TYPE_CHECKING:
    from derender.data import ImageSet
    from derender.evaluation.score_table import ScoreTable

NAMED = 5  # so many unreadable images are named
WHERE_ALL = "(derender doctor --json FILE names all)"
PLAIN_LINE_EVERY_SECONDS = 30.0


def is_main_process() -> bool:
    """Whether this process talks to the user: of those that torchrun starts together only the first does."""
    return "LOCAL_WORLD_SIZE" not in os.environ or os.environ.get("RANK", "0") == "0"


def notice(*texts: str) -> None:
    """Notes for the person at the terminal, each on a line of its own."""
    for text in texts:
        result(text, "-")


def result(text: str, json_file: str | None) -> None:
    """One line of result; it makes way on standard output where the JSON goes there."""
    if is_main_process():
        Console(stderr=json_file == "-", highlight=False, soft_wrap=True, markup=False).print(visible(text))


def visible(text: str, kept: str = "\n") -> str:
    """Text with control characters as escapes: a file's name must not steer the terminal."""
    return "".join(char if char in kept or char.isprintable() else repr(char)[1:-1] for char in text)


def report_images(images: "ImageSet", word: str = "skipped", rest: str = WHERE_ALL) -> None:
    """What was read, and the first of what was left out by name."""
    first = (f"{word} {visible(row.file, '')}: {row.reason}" for row in images.skipped[:NAMED])
    notice(images.describe(), *first)
    if (more := len(images.skipped) - NAMED) > 0:
        notice(f"and {more:,} more {rest}")


@contextmanager
def damage_as_notices() -> Iterator[None]:
    """Within the block the library's warnings of passed-over damage are notes at the terminal."""
    with warnings.catch_warnings(action="always", category=DamageNoticed):
        show = warnings.showwarning

        def say_or_show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, DamageNoticed):
                notice(str(message))
            else:
                show(message, category, *where, **more)

        warnings.showwarning = say_or_show
        yield


@contextmanager
def progress_bar(description: str, unit: str = "images") -> Iterator[Callable[..., None]]:
    """A progress bar on standard error: call the given function with (done, total) and, if any, a note.

    Where standard error is no terminal, a plain line appears every half minute instead.
    """
    console, last = Console(stderr=True), time.monotonic()
    lively = console.is_terminal and is_main_process()
    columns = (
        bars.SpinnerColumn(), bars.TextColumn("{task.description}", markup=False), bars.BarColumn(),
        bars.TaskProgressColumn(), bars.MofNCompleteColumn(),
        bars.TextColumn("{task.fields[unit]}", markup=False), bars.TimeRemainingColumn(compact=True),
        bars.TextColumn("{task.fields[note]}", style="dim", markup=False),
    )  # fmt: skip
    progress = bars.Progress(*columns, console=console, get_time=time.monotonic, speed_estimate_period=inf)
    number = progress.add_task(description, total=None, unit=unit, note="")
    (task,) = progress.tasks

    def report(done: int, total: int, note: str = "", **fields: Any) -> None:
        nonlocal last
        if fields.get("description", task.description) != task.description:
            progress.reset(number)  # the first item of a phase may wait for compiled code
        progress.update(number, completed=done, total=total, note=note, **fields)
        if not lively and time.monotonic() - last >= PLAIN_LINE_EVERY_SECONDS:
            last, left = time.monotonic(), task.time_remaining
            count = f"{task.description}: {done:,} of {total:,} {task.fields['unit']}".rstrip()
            notice(f"{count}{'' if left is None else f', {duration(left)} left'} {note}".rstrip())

    with progress if lively else nullcontext():
        yield report


def show_scores(scores: "ScoreTable", json_file: str | None) -> None:
    """A table of scores where results go: controls dim, the best of each column bold."""
    table = Table(
        title=Text(visible(scores.caption)), title_justify="left", title_style="none", box=None,
        pad_edge=False, padding=(0, 3, 0, 0),
    )  # fmt: skip
    table.add_column(Text(visible(scores.first, "")), header_style="dim")
    for column in scores.columns:
        table.add_column(Text(visible(column.head, "")), justify="right", no_wrap=True, header_style="dim")
    for row in scores.rows:
        cells = [Text(visible(text, ""), style="bold" if best else "") for text, best in scores.texts(row)]
        table.add_row(Text(visible(row.name, "")), *cells, style="dim" if row.control else "")
    console = Console(stderr=json_file == "-", highlight=False)
    if not console.is_terminal:  # a file or a pipe is as wide as the table
        widest = console.options.update(max_width=1_000)
        console.width = max(console.width, console.measure(table, options=widest).maximum)
    console.print(table, crop=False)


def write_json(target: str | None, values: Mapping[str, Any]) -> None:
    """What ``--json`` asks for: a file written whole, or standard output for ``-``; nothing for None."""
    if target is None or not is_main_process():
        return
    from derender.settings import plain

    text = json.dumps(plain(values), indent=1, ensure_ascii=False) + "\n"
    text = text.encode("utf-8", errors="backslashreplace").decode()  # names of files that are no UTF-8
    if target == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_whole(target, text)


def duration(seconds: float) -> str:
    """Seconds as a person says them."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
