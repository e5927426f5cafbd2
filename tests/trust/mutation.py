"""Breaks scene, render and objectives in small places, and tells how many of these mutants the tests kill.

    pip install cosmic-ray
    python tests/trust/mutation.py --sample 300 --seed 0 --session mutants.sqlite

cosmic-ray makes the mutants in a copy of the checkout and runs the tests of the part each is in; kernels are
compiled anew every time. A mutant is killed if a test fails, or if the tests take five times as long as
without it. Files for Triton are tested in Triton's interpreter. Left out are annotations and messages.
Survivors that no test can kill stand, with the reason, in ``equivalent_mutants.yaml``. What the session holds
is not tried again. Exit code 1 if less than 85 % of what is not equivalent was killed.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

try:
    from cosmic_ray.commands.init import init  # pyright: ignore[reportMissingImports]
    from cosmic_ray.mutating import mutate_and_test, mutate_code  # pyright: ignore[reportMissingImports]
    from cosmic_ray.plugins import get_operator  # pyright: ignore[reportMissingImports]
    from cosmic_ray.work_db import use_db  # pyright: ignore[reportMissingImports]
    from cosmic_ray.work_item import TestOutcome, WorkerOutcome  # pyright: ignore[reportMissingImports]
except ImportError:
    raise SystemExit("mutants are made by cosmic-ray: pip install cosmic-ray") from None

ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path("src") / "derender"
PARTS = ("scene", "render", "objectives")
TRITON = "TRITON_INTERPRET=1 {pytest} -k triton tests/render/test_backends.py tests/render/test_triton.py"
TESTS = {
    "scene": "{pytest} tests/scene tests/networks/test_factors.py",
    "render": "{pytest} -k 'not in_the_interpreter' tests/render",
    "objectives": "{pytest} tests/objectives",
}
FEW = ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "BitAnd_BitOr")
FEW += ("BitOr_BitAnd", "LShift_RShift", "RShift_LShift", "BitXor_BitAnd", "Eq_NotEq", "NotEq_Eq", "Is_IsNot")
FEW += ("IsNot_Is", "Lt_LtE", "Lt_Gt", "LtE_Lt", "LtE_GtE", "Gt_GtE", "Gt_Lt", "GtE_Gt", "GtE_LtE")
"""One or two replacements of each operator, so that few mutants merely crash."""

TIMES, LEAST_SECONDS = 5, 60
WANTED = 0.85


def command_of(file: Path) -> str:
    """What tests a file; kernels that stand compiled are not those of the mutant."""
    text = TRITON if file.name.startswith("triton_") else TESTS[file.relative_to(SOURCE).parts[0]]
    pytest = f"PYTHONPATH=src {sys.executable} -m pytest -x -q -n 0 -p no:cacheprovider"
    words = text.format(pytest=pytest).replace("'", '"')
    return f"bash -c 'export NUMBA_CACHE_DIR=$(mktemp -d -p kernels); {words}'"


def meant(source: str) -> str:
    """The syntax without annotations and messages."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.JoinedStr):
            node.values = []
    return ast.dump(tree)


def worth_trying(mutation) -> bool:
    """Whether a mutant is other code."""
    kind = mutation.operator_name.rpartition("/")[2]
    if kind.startswith("Replace") and "Operator_" in kind and not kind.endswith(FEW):
        return False
    source = Path(mutation.module_path).read_text()
    operator = get_operator(mutation.operator_name)(**mutation.operator_args)
    changed = mutate_code(source, operator, mutation.occurrence)
    try:
        return changed is not None and meant(changed) != meant(source)
    except SyntaxError:
        return False


def lines_of(diff: str) -> tuple[str, str]:
    """The line that was changed, before and after."""
    body = [line for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    old, new = (next((line[1:] for line in body if line[0] == mark), "(removed)") for mark in "-+")
    return old.strip(), new.strip()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sample", type=int, default=300, help="mutants to try in all; 0 for every one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--module", default="", help="only files whose path holds this")
    parser.add_argument("--session", type=Path, default=Path("mutants.sqlite"), help="cosmic-ray's own file")
    asked = parser.parse_args()
    session, taken = asked.session.resolve(), {}
    listed = yaml.safe_load(Path(__file__).with_name("equivalent_mutants.yaml").read_text())
    equivalent = {(row["before"], row["after"]) for row in listed}
    counts = {"killed": 0, "equivalent": 0, "survived": 0}
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, use_db(str(session)) as database:
        for name in ("src", "tests"):
            shutil.copytree(ROOT / name, Path(folder) / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        os.chdir(folder)
        Path("kernels").mkdir()
        paths = [path for part in PARTS for path in sorted((SOURCE / part).rglob("*.py"))]
        if not database.num_work_items:
            init([path for path in paths if asked.module in str(path)], database, {})
        items = sorted(database.work_items, key=lambda item: repr(item.mutations))
        random.Random(asked.seed).shuffle(items)
        results = dict(database.results)
        for item in items:
            if asked.sample and sum(counts.values()) >= asked.sample:
                break
            (mutation,) = item.mutations
            if not worth_trying(mutation):
                continue
            command = command_of(Path(mutation.module_path))
            if command not in taken:
                began = time.monotonic()
                subprocess.run(command, shell=True, check=True, stdout=subprocess.DEVNULL)
                taken[command] = time.monotonic() - began
            if item.job_id not in results:
                limit = max(LEAST_SECONDS, TIMES * taken[command])
                results[item.job_id] = mutate_and_test(item.mutations, command, limit)
                database.set_result(item.job_id, results[item.job_id])
            if results[item.job_id].worker_outcome != WorkerOutcome.NORMAL:
                raise RuntimeError(results[item.job_id].output)
            before, after = lines_of(results[item.job_id].diff)
            survived = results[item.job_id].test_outcome == TestOutcome.SURVIVED
            what = "killed" if not survived else "equivalent" if (before, after) in equivalent else "survived"
            counts[what] += 1
            if survived:
                print(
                    f"{what}: {mutation.module_path}:{mutation.start_pos[0]}  {before}  ->  {after}",
                    flush=True,
                )
    fair = counts["killed"] / max(1, counts["killed"] + counts["survived"])
    print(f"{counts}: {fair:.0%} of what is not equivalent")
    return 0 if fair >= WANTED else 1


if __name__ == "__main__":
    raise SystemExit(main())
