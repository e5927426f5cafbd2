"""Mutants: a source file with one small thing changed, by cosmic-ray's operators.

One or two changes for each place (``+`` becomes ``-``, ``<`` becomes ``<=`` or ``>``), so that few merely
crash. Left out are annotations, f-strings (messages), the bare star of a signature, and decorators that
change only speed or type checks. Text that the operators leave alone is docstrings and every other string.
"""

import ast
import hashlib
import math
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

try:
    from cosmic_ray.ast import ast_nodes, get_ast  # pyright: ignore[reportMissingImports]
    from cosmic_ray.mutating import mutate_code  # pyright: ignore[reportMissingImports]
    from cosmic_ray.operators.provider import OperatorProvider  # pyright: ignore[reportMissingImports]
except ImportError:
    raise SystemExit("mutants are made by cosmic-ray: pip install cosmic-ray") from None

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "derender"
REPLACED = {
    "ReplaceBinaryOperator": "Add_Sub Sub_Add Mul_Div Div_Mul Pow_Mul FloorDiv_Mul Mod_FloorDiv BitAnd_BitOr "
    "BitOr_BitAnd LShift_RShift RShift_LShift BitXor_BitAnd",
    "ReplaceComparisonOperator": "Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is Lt_LtE Lt_Gt LtE_Lt LtE_GtE "
    "Gt_GtE Gt_Lt GtE_Gt GtE_LtE",
    "ReplaceUnaryOperator": "Delete_USub Delete_Invert Delete_Not",
}
OPERATORS = [f"{kind}_{pair}" for kind, pairs in REPLACED.items() for pair in pairs.split()]
OPERATORS += [
    "AddNot",
    "ReplaceTrueWithFalse",
    "ReplaceFalseWithTrue",
    "ReplaceAndWithOr",
    "ReplaceOrWithAnd",
]
OPERATORS += ["ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ExceptionReplacer", "NumberReplacer"]
OPERATORS += ["RemoveDecorator", "ZeroIterationForLoop"]
ONLY_SPEED_OR_TYPES = ("@kernel", "@no_type_check", "@cache", "@lru_cache")


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes:
        file: below src/derender.
        where: the function it is in, "" outside of any.
        line: its number in the file.
        before, after: the line.
        text: the whole changed file.
    """

    file: str
    where: str
    line: int
    before: str
    after: str
    text: str

    @property
    def key(self) -> str:
        return f"{self.file} {hashlib.sha256(self.text.encode()).hexdigest()[:16]}"


def mutants_of(file: str) -> list[Mutant]:
    """Every mutant of a file, in its order, each changed text once."""
    text = (SOURCE / file).read_text()
    old, found, at = text.splitlines(), [], 0
    for piece in (node.get_code() for node in get_ast(text).children):  # functions, classes, statements
        for where, number, changed in changes(piece):
            whole, line = text[:at] + changed + text[at + len(piece) :], text[:at].count("\n") + number
            new = whole.splitlines()
            after = " ".join(new[line - 1].split()) if len(old) == len(new) else "(removed)"
            after = re.sub(r"(?<=[([]) +", "", after)
            found.append(Mutant(file, where, line, old[line - 1].strip(), after, whole))
        at += len(piece)
    return sorted(found, key=lambda mutant: (mutant.line, mutant.after))


def changes(text: str) -> Iterator[tuple[str, int, str]]:
    """Function, line and changed text of every mutant of a piece of Python."""
    nodes = list(ast_nodes(get_ast(text)))
    skipped = [part for node in nodes for part in left_out(node)]
    seen = {parsed(text)}
    for name in OPERATORS:
        operator = OperatorProvider()[name]()
        places = [(node, place) for node in nodes for place in operator.mutation_positions(node)]
        for occurrence, (node, (start, end)) in enumerate(places):
            if any(skip.start_pos <= start and end <= skip.end_pos for skip in skipped):
                continue
            changed = mutate_code(text, operator, occurrence)
            tree = parsed(changed)
            if tree is not None and tree not in seen and "not not" not in changed:
                seen.add(tree)
                function = node if node.type == "funcdef" else node.search_ancestor("funcdef")
                yield function.name.value if function is not None else "", start[0], changed


def left_out(node: Any) -> Iterator[Any]:
    """What of a node is not changed: the node itself, or its annotation."""
    bare_star = node.type == "operator" and node.value == "*" and node.parent.type == "parameters"
    speed = node.type == "decorator" and node.get_code().strip().startswith(ONLY_SPEED_OR_TYPES)
    if node.type == "fstring" or bare_star or speed:
        yield node
    elif node.type == "annassign":
        yield node.children[1]
    elif node.type in ("param", "funcdef") and node.annotation is not None:
        yield node.annotation


def parsed(text: str | None) -> str | None:
    """The syntax tree as a string; None where there is none."""
    try:
        return None if text is None else ast.dump(ast.parse(text))
    except SyntaxError:
        return None


def drawn(mutants: dict[str, list[Mutant]], sample: int, seed: int) -> list[Mutant]:
    """Mutants in no order, part of any larger sample; all if ``sample`` is 0.

    Each file gives by the root of how many it has, so that large kernels do not crowd out everything else.
    """
    total = sum(math.sqrt(len(found)) for found in mutants.values())
    chosen = []
    for file, found in mutants.items():
        count = len(found) if sample == 0 else max(2, round(sample * math.sqrt(len(found)) / total))
        chosen += random.Random(f"{seed} {file}").sample(found, len(found))[:count]
    return sorted(chosen, key=lambda mutant: hashlib.sha256(mutant.text.encode()).digest())
