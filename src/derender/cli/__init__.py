"""The command line: reads arguments, calls the library, says what came out.

One file per group of commands; ``main`` turns bad input into exit code 2 and one line, Ctrl-C into 130.
Nothing heavy is imported before a command runs, so that help appears at once.
"""

import errno
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import typer

from derender import __version__
from derender.cli.console import damage_as_notices, visible
from derender.cli.options import app

_REMEDIES = {
    errno.ENOSPC: "; free some space and run the command again",
    errno.EEXIST: ", a file or a broken link: choose another place",
    errno.ENOTDIR: ": a part of it is a file or a broken link: choose another place",
    errno.EACCES: ": change the permissions or choose another place",
    errno.EROFS: ": choose another place",
}


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"derender {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave."),
    ] = False,
) -> None:
    pass


for module in (
    "demo", "prepare", "train", "copies", "models", "embed", "explain", "finetune", "importing",
    "compare", "report", "decompose", "edits", "search", "view", "evaluate.features",
    "evaluate.encoders", "evaluate.scenes", "evaluate.photographs", "evaluate.robustness", "synth",
):  # fmt: skip
    import_module(f"derender.cli.{module}")
_command = typer.main.get_command(app)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; gives the exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if "_DERENDER_COMPLETE" in os.environ:  # a shell asks for completions
        _command._main_shell_completion({}, "derender")  # answers and ends
    try:
        with damage_as_notices(), _command.make_context("derender", arguments) as context:
            _command.invoke(context)  # typer's main hides the message of Ctrl-C
        sys.stdout.flush()
        return 0
    except typer.Exit as end:
        return end.exit_code
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (KeyboardInterrupt, typer.Abort) as error:
        _complain(str(error) or "stopped by Ctrl-C; nothing half-written was kept")
        return 130
    except (ValueError, OSError) as error:
        if os.environ.get("DERENDER_TRACEBACK"):
            raise
        message = str(error) or type(error).__name__
        if isinstance(error, OSError) and error.errno is not None and error.strerror:
            where = f"{error.filename}: " if error.filename is not None else ""
            message = f"{where}{error.strerror.lower()}{_REMEDIES.get(error.errno, '')}"
        _complain(message)
        return 2
    except Exception as error:
        describe = getattr(error, "format_message", None)  # bad words; typer has several kinds
        if describe is None:
            if not _speaks_of_errors():
                return 1
            raise
        if message := describe().strip():  # none where no command was given: help has been shown
            command = getattr(getattr(error, "ctx", None), "command_path", "derender")
            _complain(f"{message.rstrip('.')} (see {command} --help)")
        return 2


def _speaks_of_errors() -> bool:
    """Of processes that torchrun started together the first that fails says why, the others say nothing."""
    if "LOCAL_WORLD_SIZE" not in os.environ:
        return True
    from derender.training.distributed import first_to_fail

    return first_to_fail()


def _complain(message: str) -> None:
    """What, where and what to do, on one line."""
    if _speaks_of_errors():
        sys.stderr.write(f"derender: {visible(' '.join(message.split()))}\n")
