"""The size and the words of the house: lines and files per package, names that stand once, plain language.

A budget is lowered when there is room, and raised only with the reason in the same commit.
"""

import ast
import re
from collections import Counter, defaultdict
from pathlib import Path

import pytest
from tests.test_project import PACKAGE, SOURCES, TESTS, syntax

BUDGET = {  # lines, files
    "data": (6_480, 30), "evaluation": (6_689, 32), "report": (3_654, 21), "cli": (2_082, 28),
    "training": (3_485, 19), "baselines": (2_309, 11), "render": (1_660, 15), "features": (1_246, 8),
    "interpretation": (986, 5), "photo": (1_567, 7), "networks": (668, 5), "storage": (884, 7),
    "objectives": (600, 5), "postprocess": (964, 5), "scene": (847, 11), "demo": (452, 3),
    "renderers": (627, 8), "learn": (897, 5),
}  # fmt: skip
TOTAL = (36_788, 233)
TEST_LINES = 26_000
LONGEST = {"model.py": 180}
LONGEST_COMMAND = 80
SHARED_BY_COMMANDS = {"__init__.py", "console.py", "options.py", "scoring.py"}

PRIVATE = ("found", "told", "said", "taught")  # a result, a record, a message
BANNED = re.compile(
    r"\b(nobody|taken? apart|takes apart|told apart|comes? along|given away|rendered again|as read|"
    r"what encoders say|is asked of|numbers that are none|odd pictures?|goe?s on with|gone on with)\b",
    re.IGNORECASE,
)


def length(path: Path) -> int:
    return path.read_text(encoding="utf-8").count("\n")


def sizes() -> dict[str, tuple[int, int]]:
    """Lines and files of every package; single modules at the top are counted as one, "(top)"."""
    result: dict[str, list[int]] = defaultdict(list)
    for path in SOURCES:
        parts = path.relative_to(PACKAGE).parts
        result[parts[0] if len(parts) > 1 else "(top)"].append(length(path))
    return {name: (sum(lines), len(lines)) for name, lines in result.items()}


def test_every_package_keeps_to_its_budget():
    result = sizes()
    shown = "\n".join(
        f"{name:<16}{lines:>7,} lines {files:>4} files   budget {BUDGET.get(name)}"
        for name, (lines, files) in sorted(result.items(), key=lambda row: -row[1][0])
    )
    over = [name for name, most in BUDGET.items() if result[name][0] > most[0] or result[name][1] > most[1]]
    assert not over, f"over budget: {over}\n{shown}"
    total = tuple(map(sum, zip(*result.values(), strict=True)))
    assert total[0] <= TOTAL[0] and total[1] <= TOTAL[1], f"{total} of {TOTAL}\n{shown}"


def test_the_tests_keep_to_their_budget():
    assert sum(map(length, TESTS)) <= TEST_LINES


@pytest.mark.parametrize(("name", "most"), LONGEST.items())
def test_the_model_fits_on_a_screen(name, most):
    assert length(PACKAGE / name) <= most


def test_a_command_is_a_short_file():
    commands = [one for one in (PACKAGE / "cli").rglob("*.py") if one.name not in SHARED_BY_COMMANDS]
    long = {str(one.relative_to(PACKAGE)): length(one) for one in commands if length(one) > LONGEST_COMMAND}
    assert not long, f"parse, call, print: move the rest into the library: {long}"


def test_no_two_classes_share_a_name():
    nodes = (node for path in SOURCES for node in ast.walk(syntax(path)))
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    assert not (twice := [name for name, count in names.items() if count > 1]), twice


def test_no_variable_has_a_private_name():
    named = {
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in SOURCES
        for function in ast.walk(syntax(path))
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if (name := getattr(node, "id", getattr(node, "arg", ""))) in PRIVATE
    }
    assert not named, sorted(named)


def public_texts(path: Path) -> list[str]:
    """Docstrings of a module and of what is public in it, and help texts of options."""
    tree = syntax(path)
    results = [ast.get_docstring(tree) or ""]
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            results.append(ast.get_docstring(node) or "")
        helps = isinstance(node, ast.keyword) and node.arg == "help"
        if (helps or isinstance(node, ast.Assign)) and isinstance(node.value, ast.Constant):
            results.append(str(node.value.value))  # of options, some named before
    return results


def test_public_texts_use_the_words_of_the_field():
    """docs/glossary.md has the words that take the place of these."""
    results = [
        f"{path.relative_to(PACKAGE)}: {match[0]}"
        for path in SOURCES
        for text in public_texts(path)
        for match in BANNED.finditer(text)
    ]
    assert not results, "\n".join(results)


def test_help_texts_are_whole_phrases():
    headless = [
        f"{path.relative_to(PACKAGE)}: {value.value}"
        for path in (PACKAGE / "cli").rglob("*.py")
        for node in ast.walk(syntax(path))
        if isinstance(node, ast.Assign) or (isinstance(node, ast.keyword) and node.arg == "help")
        if isinstance(value := node.value, ast.Constant) and str(value.value).startswith(("Of ", "Or "))
    ]
    assert not headless, "\n".join(headless)
