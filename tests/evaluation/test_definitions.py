"""reference/metrics.md: every column that a table prints is defined there, every function it names exists."""

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "metrics.md").read_text()
TABLES = (
    *("evaluation/clustering", "evaluation/clustering_scores", "evaluation/linear_probing"),
    *("evaluation/paper_tables", "evaluation/score_table", "evaluation/disentanglement/card"),
    *("evaluation/segmentation", "evaluation/robust"),
    *("evaluation/truth", "evaluation/pixels"),
)


def columns(module: str) -> set[str]:
    """Names of the columns that a module of tables makes."""
    tree = ast.parse((ROOT / "src" / "derender" / f"{module}.py").read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and node.args]
    place = {"Column": 0, "metric": 1}
    functions = [(call, getattr(call.func, "id", "")) for call in calls]
    named = [call.args[place[name]] for call, name in functions if name in place]
    return {one.value for one in named if isinstance(one, ast.Constant) and isinstance(one.value, str)}


def defined(name: str) -> bool:
    """Whether a table of the page has a row of this name, or its text has it in bold or as code."""
    word = re.escape(name)
    return re.search(rf"^\| {word}( \||,)|\| {word} \||\*\*{word}\*\*|`{word}`", PAGE, re.M) is not None


@pytest.mark.parametrize("module", TABLES)
def test_every_column_is_defined(module):
    result = columns(module)
    assert result, f"{module} makes no column: is it still where tables are made?"
    assert sorted(name for name in result if not defined(name)) == []


def test_a_column_that_is_nowhere_is_missed():
    assert not defined("no such score") and not defined("accurac")


def test_functions_on_arrays_are_exported():
    section = PAGE.split("## On arrays")[1].split("Pinned by")[0]
    cells = [line.split("|")[2] for line in section.splitlines() if line.startswith("|")][2:]
    assert len(cells) == 12
    for cell in cells:
        module = importlib.import_module("derender.evaluation")
        for word in re.findall(r"`([\w.]+)`", cell):
            if "." in word:
                folder, word = word.split(".")
                module = importlib.import_module(f"derender.evaluation.{folder}")
            assert callable(getattr(module, word, None)), word
