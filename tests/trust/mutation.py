"""Breaks scene, render and objectives in small places, and tells how many of these mutants the tests kill.

    pip install cosmic-ray
    python tests/trust/mutation.py --sample 300 --seed 0 --journal mutants.jsonl

``mutants.py`` makes the mutants. Each stands in a copy of the package that a forked child, which has torch
and numba ready, puts before the real one; compiled kernels that the mutant is part of are compiled anew, in a
folder of its own. It is killed if a test fails, or by time if the tests take five times as long as without
it. Files for Triton are tested in Triton's interpreter. Survivors that no test can kill stand, with the
reason, in ``equivalent_mutants.yaml``. Finished mutants in the journal are not tried again; with ``--again``
the other survivors are. Exit code 1 if less than 85 % of what is not equivalent was killed.
"""

import argparse
import importlib
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numba
import pytest
import torch  # noqa: F401  children find it ready
import yaml
from apart import start, waited
from mutants import ROOT, SOURCE, Mutant, drawn, mutants_of

PARTS = ("scene", "render", "objectives")
ALSO = {"scene": ("tests/networks/test_factors.py",)}
"""Tests outside of a part's own folder that hold its numbers, too."""

IN_A_PROCESS_OF_ITS_OWN = "test_kernels_agree_with_the_definition_in_the_interpreter"
"""Starts Triton's interpreter; only mutants of Triton's files need it, and they run in it anyway."""

ALSO_READY = (
    "torch._dynamo",
    "scipy.interpolate",
    "hypothesis",
    "pydantic",
    "PIL.Image",
    "safetensors.torch",
)
"""Imported before children are made; some of it imports Triton, too early where its interpreter is needed."""

LISTED = ("file", "where", "before", "after")
"""By which a mutant is known in the list of equivalent ones."""

RESULTS = ("killed", "by time", "survived", "equivalent")
TIMES, LEAST_SECONDS, MEMORY = 5, 60, 16 << 30
WANTED = 0.85


def compiled_into(file: str) -> set[str]:
    """Folders of render/ whose compiled kernels hold code or constants of this file."""
    stale, wanted = set(), {file}
    for _ in range(3):  # kernels use those of other folders, and these a file of constants
        for kernels in sorted((SOURCE / "render").glob("*/numba_kernels.py")):
            name = kernels.relative_to(SOURCE).as_posix()
            imports = re.findall(r"from derender\.([\w.]+)", kernels.read_text())
            if name in wanted or wanted & {f"{module.replace('.', '/')}.py" for module in imports}:
                stale.add(kernels.parent.name)
                wanted.add(name)
    return stale


def group_of(file: str) -> str:
    """The part a file is of; "triton" for what runs on a GPU only, or in Triton's interpreter."""
    return "triton" if Path(file).name.startswith("triton_") else file.split("/")[0]


def tests_of(file: str) -> tuple[str, ...]:
    """Test files that may kill a mutant of this file, those nearest to it first."""
    group, stem = group_of(file), Path(file).stem
    if group == "triton":
        return ("tests/render/test_backends.py", "tests/render/test_triton.py")
    dotted = f"derender.{file.removesuffix('.py').removesuffix('/__init__').replace('/', '.')}"
    near = sorted(
        (ROOT / "tests" / group).glob("test_*.py"),
        key=lambda test: (test.stem != f"test_{stem}", -test.read_text().count(dotted), test.name),
    )
    return (*(test.relative_to(ROOT).as_posix() for test in near), *ALSO.get(group, ()))


@dataclass(frozen=True)
class FirstFailure:
    """Notes which test failed first, and whether what was tested is the copy."""

    note: Path
    package: Path

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.note.write_text(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        import derender

        if Path(derender.__file__).parent != self.package:
            os._exit(99)


class Workshop:
    """A copy of package and tests in which one file at a time is changed, and its caches."""

    def __init__(self, folder: Path):
        self.folder, self.package, self.compiled = folder, folder / "src" / "derender", folder / "compiled"
        for name in ("src", "tests"):
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        self.seconds: dict[str, float] = {}

    def run(self, file: str, seconds: float, stale: set[str], mutant: Mutant | None = None) -> dict[str, Any]:
        """Run the tests of a file, with a mutant or without; kernels of stale folders are compiled anew.

        Gives the exit code (None where time was up), seconds, and the test that failed first.
        """
        warm = self.folder / "warm" / group_of(file)  # kernels of the package as it is
        warm.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self.compiled, ignore_errors=True)
        unusable = shutil.ignore_patterns(*(f"{folder}_*" for folder in stale))
        shutil.copytree(warm, self.compiled, ignore=unusable)
        note, changed, kept = self.folder / "failed", self.package / file, self.folder / "kept"
        note.unlink(missing_ok=True)
        shutil.copy2(changed, kept)
        if mutant is not None:
            changed.write_text(mutant.text)
        began = time.monotonic()
        child = start(partial(self.child, file, note, mutant is None), self.folder / "log", failed=98)
        code = waited(child, seconds)
        if code is None:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
        shutil.copy2(kept, changed)  # with its time, by which caches know it
        if mutant is None:
            shutil.copytree(self.compiled, warm, dirs_exist_ok=True)
        by = note.read_text() if note.exists() else ""
        return {"code": code, "seconds": round(time.monotonic() - began, 1), "by": by}

    def child(self, file: str, note: Path, write: bool) -> int:
        triton = group_of(file) == "triton"
        os.setpgrp()
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.environ |= {
            "PYTHONPATH": str(self.package.parent),
            "DERENDER_SHARED": os.environ.get("DERENDER_SHARED", str(ROOT.parent / "shared")),
            "NUMBA_CACHE_DIR": str(self.compiled),
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self.folder / "hypothesis"),
        }
        os.environ |= {"TRITON_INTERPRET": "1"} if triton else {}
        os.environ |= {} if write else {"PYTHONDONTWRITEBYTECODE": "1"}
        sys.dont_write_bytecode = not write
        numba.config.CACHE_DIR = str(self.compiled)  # pyright: ignore
        elsewhere = [path for path in sys.path if Path(path) not in (SOURCE.parent, Path(__file__).parent)]
        sys.path[:] = [str(self.package.parent), str(self.folder), *elsewhere]
        os.chdir(self.folder)
        options = ["-x", "-q", "--tb=short", "-p", "no:cacheprovider", "-p", "no:xdist"]
        options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        options += ["-k", "triton"] if triton else ["-k", f"not {IN_A_PROCESS_OF_ITS_OWN}"]
        return int(pytest.main([*options, *tests_of(file)], plugins=[FirstFailure(note, self.package)]))

    def undisturbed(self, file: str) -> float:
        """Seconds that the tests of a file's group take without a mutant; they have to pass."""
        group = group_of(file)
        if group not in self.seconds:
            found = self.run(file, 1800, stale={"*"})
            if found["code"] != 0:
                end = (self.folder / "log").read_text()[-3000:]
                raise SystemExit(f"{end}\nthe tests of {group} do not pass without any mutant")
            self.seconds[group] = found["seconds"]
        return self.seconds[group]

    def results(self, mutants: Sequence[Mutant]) -> Iterator[dict[str, Any]]:
        """A line of the journal for each, as it comes: "killed", "by time" or "survived"."""
        for number, mutant in enumerate(mutants, 1):
            limit = max(LEAST_SECONDS, TIMES * self.undisturbed(mutant.file))
            found = self.run(mutant.file, limit, compiled_into(mutant.file), mutant)
            if found["code"] in (98, 99):
                raise RuntimeError(f"the copy was not tested:\n{(self.folder / 'log').read_text()}")
            result = "by time" if found["code"] is None else "killed" if found["code"] else "survived"
            entry = {"key": mutant.key, **asdict(mutant), **found, "result": result}
            del entry["text"]
            print(
                f"{number}/{len(mutants)} {result} {mutant.file}:{mutant.line}", file=sys.stderr, flush=True
            )
            yield entry


def equivalents() -> dict[tuple[str, ...], str]:
    """Why no test can kill a mutant, by what it is known by."""
    listed = yaml.safe_load(Path(__file__).with_name("equivalent_mutants.yaml").read_text()) or []
    return {tuple(row[name] for name in LISTED): row["why"] for row in listed}


def scores(rows: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """Shares killed, by time or not: of all mutants, and of those that are not equivalent."""
    dead = sum(row["result"] in ("killed", "by time") for row in rows)
    fair = sum(row["result"] != "equivalent" for row in rows)
    return dead / len(rows), dead / fair if fair else 1.0


def tell(rows: list[dict[str, Any]], counts: dict[str, int]) -> None:
    """Markdown: a line per file, then one for all; then what survived."""
    print(f"| file | mutants | tried | {' | '.join(RESULTS)} | score | without equivalents |")
    print("| --- |" + " ---: |" * 8)
    groups = [(f"`{file}`", [row for row in rows if row["file"] == file], counts[file]) for file in counts]
    for name, own, count in [*groups, ("**all**", rows, sum(counts.values()))]:
        if own:
            each = [sum(row["result"] == what for row in own) for what in RESULTS]
            shares = [f"{share:.0%}" for share in scores(own)]
            print(f"| {name} | {' | '.join(map(str, (count, len(own), *each, *shares)))} |")
    for row in rows:
        if row["result"] in ("survived", "equivalent"):
            told = f"{row['result']}: {row['file']}:{row['line']}  {row['before']}  ->  {row['after']}"
            print(told, row.get("why", ""))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sample", type=int, default=300, help="mutants to try in all; 0 for every one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--module", help="this file below src/derender alone, as render/renderer.py")
    parser.add_argument("--journal", type=Path, help="a line of JSON for every mutant; goes on from there")
    parser.add_argument("--again", action="store_true", help="try the journal's survivors again")
    parser.add_argument("--json", type=Path, help="write everything here, too")
    asked = parser.parse_args()
    paths = [path for part in PARTS for path in sorted((SOURCE / part).rglob("*.py"))]
    files = [path.relative_to(SOURCE).as_posix() for path in paths]
    if asked.module not in (None, *files):
        raise SystemExit(f"--module is a file of {', '.join(PARTS)}, got {asked.module!r}")
    mutants = {file: mutants_of(file) for file in files if asked.module in (None, file)}
    mutants = {file: found for file, found in mutants.items() if found}
    chosen, why = drawn(mutants, asked.sample, asked.seed), equivalents()
    known: dict[str, dict[str, Any]] = {}
    if asked.journal is not None and asked.journal.exists():
        entries = [json.loads(line) for line in asked.journal.read_text().splitlines()]
        known = {entry["key"]: entry for entry in entries}
    left = [
        mutant
        for mutant in chosen
        if mutant.key not in known or (asked.again and known[mutant.key]["result"] == "survived")
    ]
    numba.njit(lambda value: value + 1)(1.0)  # children find the compiler ready
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        workshop = Workshop(Path(folder))
        for triton in (True, False):
            for name in () if triton else ALSO_READY:
                importlib.import_module(name)
            for entry in workshop.results(
                [one for one in left if (group_of(one.file) == "triton") == triton]
            ):
                known[entry["key"]] = entry
                if asked.journal is not None:
                    with asked.journal.open("a") as stream:
                        stream.write(json.dumps(entry) + "\n")
    rows = [{**known[mutant.key], "line": mutant.line} for mutant in chosen]
    for row in rows:
        if row["result"] == "survived" and (reason := why.get(tuple(row[name] for name in LISTED))):
            row |= {"result": "equivalent", "why": reason}
    tell(rows, {file: len(found) for file, found in mutants.items()})
    raw, fair = scores(rows)
    if asked.json is not None:
        told = {"killed": raw, "killed_without_equivalents": fair, "mutants": rows}
        asked.json.write_text(json.dumps(told, indent=1))
    return 0 if fair >= WANTED else 1


if __name__ == "__main__":
    raise SystemExit(main())
