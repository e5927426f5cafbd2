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
import functools
import importlib
import json
import os
import re
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numba
import pytest
import torch  # noqa: F401  children find it ready
import yaml
from apart import ended, start, waited
from mutants import ROOT, SOURCE, Mutant, drawn, mutants_of

PARTS = ("scene", "render", "objectives")
ALSO = {"scene": ("tests/networks/test_factors.py",), "render": (), "objectives": ()}
"""Tests outside of a part's own folder that hold its numbers, too."""

IN_A_PROCESS_OF_ITS_OWN = "test_kernels_agree_with_the_definition_in_the_interpreter"
"""Starts Triton's interpreter; only mutants of Triton's files need it, and they run in it anyway."""

ALSO_READY = ("torch._dynamo", "scipy.interpolate", "hypothesis", "pydantic", "PIL.Image")
ALSO_READY += ("safetensors.torch",)
"""Imported before children are made; some of it imports Triton, too early where its interpreter is needed."""

LISTED = ("file", "where", "before", "after")
"""By which a mutant is known in the list of equivalent ones."""

TIMES, LEAST_SECONDS, MEMORY = 5, 60, 16 << 30
WANTED = 0.85


def compiled_into(file: str) -> set[str]:
    """Folders of render/ whose compiled kernels hold code or constants of this file."""
    stale, wanted = set(), {file}
    for _ in range(3):  # kernels use those of other folders, and these a file of constants
        for kernels in sorted((SOURCE / "render").glob("*/numba_kernels.py")):
            name, text = kernels.relative_to(SOURCE).as_posix(), kernels.read_text()
            imported = {
                f"{module.replace('.', '/')}.py" for module in re.findall(r"from derender\.([\w.]+)", text)
            }
            if name in wanted or imported & wanted:
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
    return (*(test.relative_to(ROOT).as_posix() for test in near), *ALSO[group])


class FirstFailure:
    """Notes which test failed first, and whether what was tested is the copy."""

    def __init__(self, note: Path, package: Path):
        self.note, self.package = note, package

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.note.write_text(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        import derender

        if Path(derender.__file__).parent != self.package:
            os._exit(99)


@dataclass(frozen=True)
class Outcome:
    """How tests ended: exit code, None where time was up; seconds; the test that failed first."""

    code: int | None
    seconds: float
    by: str


class Workshop:
    """A copy of package and tests in which one file at a time is changed, and its caches."""

    def __init__(self, folder: Path):
        self.folder, self.package = folder, folder / "src" / "derender"
        self.compiled = folder / "compiled"
        for name in ("src", "tests"):
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)

    def run(self, file: str, seconds: float, *, stale: set[str], mutant: Mutant | None = None) -> Outcome:
        """Run the tests of a file, with a mutant or without; kernels of stale folders are compiled anew."""
        shutil.rmtree(self.compiled, ignore_errors=True)
        unusable = shutil.ignore_patterns(*(f"{folder}_*" for folder in stale))
        shutil.copytree(self.warm(file), self.compiled, ignore=unusable)
        note = self.folder / "failed"
        note.unlink(missing_ok=True)
        changed, kept = self.package / file, self.folder / "kept"
        shutil.copy2(changed, kept)
        if mutant is not None:
            changed.write_text(mutant.text)
        began = time.monotonic()
        triton, write = group_of(file) == "triton", mutant is None
        tests = functools.partial(self._child, tests_of(file), note, triton=triton, write=write)
        child = start(tests, self.folder / "log", failed=98)
        code = waited(child, seconds)
        if code is None:
            ended(child, group=True)
        shutil.copy2(kept, changed)  # with its time, by which caches know it
        return Outcome(code, time.monotonic() - began, note.read_text() if note.exists() else "")

    def warm(self, file: str) -> Path:
        """Kernels of the package as it is, compiled by the tests of this group."""
        folder = self.folder / "warm" / group_of(file)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _child(self, tests: Sequence[str], note: Path, *, triton: bool, write: bool) -> int:
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
        return int(pytest.main([*options, *tests], plugins=[FirstFailure(note, self.package)]))


def undisturbed(workshop: Workshop, files: Sequence[str]) -> dict[str, float]:
    """Seconds that each group's tests take without a mutant, kernels compiled anew; they have to pass."""
    found: dict[str, float] = {}
    for file in files:
        if group_of(file) in found:
            continue
        outcome = workshop.run(file, 1800, stale={"*"})
        if outcome.code != 0:
            end = (workshop.folder / "log").read_text()[-3000:]
            raise SystemExit(f"{end}\nthe tests of {group_of(file)} do not pass without any mutant")
        shutil.copytree(workshop.compiled, workshop.warm(file), dirs_exist_ok=True)
        print(f"tests of {group_of(file)}: {outcome.seconds:.0f} s", file=sys.stderr, flush=True)
        found[group_of(file)] = outcome.seconds
    return found


def tried(workshop: Workshop, mutant: Mutant, seconds: float) -> dict[str, Any]:
    """What became of a mutant: "killed", "by time" or "survived"."""
    limit = max(LEAST_SECONDS, TIMES * seconds)
    outcome = workshop.run(mutant.file, limit, stale=compiled_into(mutant.file), mutant=mutant)
    if outcome.code in (98, 99):
        log = (workshop.folder / "log").read_text()
        raise RuntimeError(f"the copy of the package was not tested:\n{log}")
    result = "by time" if outcome.code is None else "killed" if outcome.code else "survived"
    return {"result": result, "by": outcome.by, "code": outcome.code, "seconds": round(outcome.seconds, 1)}


def results(workshop: Workshop, mutants: Sequence[Mutant]) -> Iterator[dict[str, Any]]:
    """A line of the journal for each, as it comes; says so on stderr."""
    seconds = undisturbed(workshop, sorted({mutant.file for mutant in mutants}))
    for number, mutant in enumerate(mutants, 1):
        entry = {
            "key": mutant.key,
            **asdict(mutant),
            **tried(workshop, mutant, seconds[group_of(mutant.file)]),
        }
        entry.pop("text")
        said = f"{number}/{len(mutants)} {entry['result']} {mutant.file}:{mutant.line} {entry['seconds']} s"
        print(said, file=sys.stderr, flush=True)
        yield entry


@functools.cache
def equivalents() -> dict[tuple[str, ...], str]:
    listed = yaml.safe_load(Path(__file__).with_name("equivalent_mutants.yaml").read_text()) or []
    return {tuple(row[name] for name in LISTED): row["why"] for row in listed}


def equivalent(row: dict[str, Any]) -> str:
    """Why no test can kill it; "" for one that is not listed."""
    return equivalents().get(tuple(row[name] for name in LISTED), "")


def table(rows: list[dict[str, Any]], counts: dict[str, int]) -> str:
    """Markdown: a line per file, then one for all; ``score`` of all, and of those that are not equivalent."""
    names = ("killed", "by time", "survived", "equivalent")
    lines = [
        "| file | mutants | tried | killed | by time | survived | equivalent | score | without equivalents |"
    ]
    lines.append("| --- |" + " ---: |" * 8)
    groups = [(f"`{file}`", [row for row in rows if row["file"] == file], counts[file]) for file in counts]
    for name, own, count in [*groups, ("**all**", rows, sum(counts.values()))]:
        if own:
            each = [sum(row["result"] == what for row in own) for what in names]
            raw, fair = scores(own)
            figures = " | ".join(str(number) for number in (count, len(own), *each))
            lines.append(f"| {name} | {figures} | {raw:.0%} | {fair:.0%} |")
    return "\n".join(lines)


def scores(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Shares killed, by time or not: of all mutants, and of those that are not equivalent."""
    dead = sum(row["result"] in ("killed", "by time") for row in rows)
    fair = sum(row["result"] != "equivalent" for row in rows)
    return dead / len(rows), dead / fair if fair else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sample", type=int, default=300, help="mutants to try in all; 0 for every one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--module", help="this file below src/derender alone, as render/renderer.py")
    parser.add_argument(
        "--journal", type=Path, help="a line of JSON for every mutant; goes on from what it holds"
    )
    parser.add_argument("--again", action="store_true", help="try the journal's survivors again")
    parser.add_argument("--json", type=Path, help="write everything here, too")
    arguments = parser.parse_args()
    files = [
        path.relative_to(SOURCE).as_posix()
        for part in PARTS
        for path in sorted((SOURCE / part).rglob("*.py"))
    ]
    if arguments.module is not None and arguments.module not in files:
        raise SystemExit(
            f"--module is a file of {', '.join(PARTS)} below src/derender, got {arguments.module!r}"
        )
    mutants = {
        file: found for file in files if arguments.module in (None, file) and (found := mutants_of(file))
    }
    chosen = drawn(mutants, arguments.sample, arguments.seed)
    known: dict[str, dict[str, Any]] = {}
    if arguments.journal is not None and arguments.journal.exists():
        for line in arguments.journal.read_text().splitlines():
            entry = json.loads(line)
            known[entry["key"]] = entry
    again = {key for key, entry in known.items() if entry["result"] == "survived" and not equivalent(entry)}
    settled = known.keys() - (again if arguments.again else set())
    left = [mutant for mutant in chosen if mutant.key not in settled]
    numba.njit(lambda value: value + 1)(1.0)  # children find the compiler ready
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        workshop = Workshop(Path(folder))
        for triton in (True, False):
            group = [mutant for mutant in left if (group_of(mutant.file) == "triton") == triton]
            for name in () if triton else ALSO_READY:
                importlib.import_module(name)
            for entry in results(workshop, group):
                known[entry["key"]] = entry
                if arguments.journal is not None:
                    with arguments.journal.open("a") as stream:
                        stream.write(json.dumps(entry) + "\n")
    return told(chosen, known, {file: len(found) for file, found in mutants.items()}, arguments.json)


def told(
    chosen: list[Mutant], known: dict[str, dict[str, Any]], counts: dict[str, int], to: Path | None
) -> int:
    """Print the table and the survivors; the exit code."""
    rows = []
    for mutant in chosen:
        row = {**known[mutant.key], "line": mutant.line}
        if row["result"] == "survived" and equivalent(row):
            row |= {"result": "equivalent", "why": equivalent(row)}
        rows.append(row)
    print(table(rows, counts))
    for row in rows:
        if row["result"] in ("survived", "equivalent"):
            why = f" ({row['why']})" if "why" in row else ""
            print(f"{row['result']}: {row['file']}:{row['line']}  {row['before']}  ->  {row['after']}{why}")
    raw, fair = scores(rows)
    if to is not None:
        to.write_text(
            json.dumps({"killed": raw, "killed_without_equivalents": fair, "mutants": rows}, indent=1)
        )
    return 0 if fair >= WANTED else 1


if __name__ == "__main__":
    raise SystemExit(main())
