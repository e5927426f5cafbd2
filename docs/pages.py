"""What the pages of this site take from files: tables of results, and the output of the tutorials.

    python docs/pages.py                 # rewrite every table that a page names
    python docs/pages.py tutorials       # run the tutorials and rewrite the output that they show

A page names a table of ``result_tables.FILES`` as ``<!-- table: people -->``; it ends with ``<!-- end -->``.
"""

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from pathlib import Path
from typing import Any

from result_tables import table

ROOT = Path(__file__).resolve().parents[1]
TABLE = re.compile(r"<!-- table: (\S+) -->\n(.*?)<!-- end -->", re.DOTALL)
TUTORIALS = ("quickstart", "own-folder", "scikit-learn")
STEP = re.compile(r"```(python|sh)\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)


def pages() -> list[Path]:
    """Every page of the site that may hold a table, and the README."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def with_tables(page: str) -> str:
    """A page with each of its tables as its file has it."""
    return TABLE.sub(lambda m: f"<!-- table: {m[1]} -->\n{table(m[1])}\n<!-- end -->", page)


def run_tutorial(text: str) -> tuple[str, dict[str, bytes]]:
    """A tutorial run step by step in an empty folder: the page with its output, and the files it made.

    Python blocks share one namespace; each line of a shell block is one derender command. A ```text block
    below a step holds what the step prints.
    """
    from derender.cli import main

    names: dict[str, Any] = {"__name__": "__main__"}

    def run(match: re.Match[str]) -> str:
        kind, code, shown = match.groups()
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()) as notices:
            if kind == "python":
                exec(compile(code, "tutorial", "exec"), names)
            else:
                for line in code.replace("\\\n", " ").splitlines():
                    words = shlex.split(line, comments=True)
                    if words and main(words[1:]):
                        raise RuntimeError(f"{line}\n{notices.getvalue()}")
        output = "\n".join(line.rstrip() for line in printed.getvalue().strip().splitlines())
        step = f"```{kind}\n{code}```"
        return f"{step}\n\n```text\n{output}\n```" if shown is not None else step

    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            text = STEP.sub(run, text)
        finally:
            os.chdir(before)
        made = {path.name: path.read_bytes() for path in Path(folder).glob("*.png")}
    return text, made


def main() -> None:
    if sys.argv[1:2] == ["tutorials"]:
        for name in sys.argv[2:] or TUTORIALS:
            page = ROOT / "docs" / "tutorials" / f"{name}.md"
            text, made = run_tutorial(page.read_text())
            page.write_text(text)
            for image in re.findall(r"\(\.\./images/tutorials/([\w-]+\.png)\)", text):
                (ROOT / "docs" / "images" / "tutorials" / image).write_bytes(made[image])
            print(page.relative_to(ROOT))
        return
    for page in pages():
        old = page.read_text()
        if (new := with_tables(old)) != old:
            page.write_text(new)
            print(page.relative_to(ROOT))


if __name__ == "__main__":
    main()
