"""Writes advisories.md into build/release: known security advisories that reach an allowed version.

    python tests/trust/advisories.py

Reads advisories.yaml beside it (what was looked up, by hand), pyproject.toml and both constraints. Nothing
is asked of a network, so it knows of no advisory that is younger than its list.
"""

import tomllib
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "build" / "release" / "advisories.md"
LIST = Path(__file__).with_name("advisories.yaml")
PAGE_HEAD = """\
# Security advisories of what derender needs

Looked up on {day} for {packages} packages: those of `constraints.txt` (tested) and of
`constraints-lowest.txt`, and the lower bounds of `pyproject.toml`. {searches} searches over
records of CVE, OSV, GHSA and PyPA and reports about them, up to November 2026, and a copy
of PyPA's advisory database that ends in early 2024. No live database was asked (`pip-audit` found
none that answered): run `pip-audit -r constraints.txt` where there is a network. Empty rows say
that nothing was found, not that there is nothing. This page is written by
`python tests/trust/advisories.py` from `tests/trust/advisories.yaml`; a test holds that list
against the versions.

## Tested versions that an advisory reaches

{tested}

## Lowest versions that an advisory reaches, while the tested one is free of it

{lowest}

## No longer allowed

Advisories of versions that were allowed before; lower bounds stand above them now.

{passed}

## Every package

| package | tested | lowest | PyPA's records to 2024 | searches | newest advisory seen | note |
| --- | --- | --- | ---: | ---: | --- | --- |
"""


@dataclass(frozen=True)
class Advisory:
    """One flaw; fields as in advisories.yaml."""

    id: str
    affected: tuple[SpecifierSet, ...]
    fixed: str | None
    severity: str | None
    summary: str
    source: str
    aliases: tuple[str, ...] = ()

    def reaches(self, version: Version) -> bool:
        return any(version in those for those in self.affected)

    def row(self, package: str) -> str:
        """A line of the page."""
        graded = f" ({self.severity})" if self.severity else ""
        affected = "; ".join(", ".join(sorted(map(str, those))) for those in self.affected)
        fixed, summary = self.fixed or "not known", self.summary.replace("|", "/")
        return f"| {package} | [{self.id}]({self.source}){graded} | {affected} | {fixed} | {summary} |"


@dataclass(frozen=True)
class Looked:
    """What was found for one package; fields as in advisories.yaml."""

    package: str
    records: int
    searches: int
    newest: str | None
    note: str = ""
    answer: str = ""
    advisories: tuple[Advisory, ...] = ()

    def reaching(self, version: Version) -> tuple[Advisory, ...]:
        return tuple(one for one in self.advisories if one.reaches(version))


def advisory(row: dict[str, Any]) -> Advisory:
    affected = tuple(SpecifierSet(text, prereleases=True) for text in row["affected"])
    return Advisory(**{**row, "affected": affected})


def looked_up(file: Path = LIST) -> tuple[str, dict[str, Looked]]:
    """The day, and what was found by package."""
    tree = yaml.safe_load(file.read_text())
    rows = [{**row, "advisories": (*map(advisory, row.get("advisories", ())),)} for row in tree["packages"]]
    return str(tree["looked_up"]), {row["package"]: Looked(**row) for row in rows}


def pins(file: Path) -> dict[str, Version]:
    """Versions by package."""
    lines = [line.partition("==") for line in file.read_text().splitlines() if line[:1] != "#"]
    return {canonicalize_name(name): Version(version) for name, mark, version in lines if mark}


def lower_bounds() -> dict[str, Version]:
    """The lowest versions that pyproject.toml allows of what it names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    results = {}
    for wanted in map(Requirement, texts):
        lowest = [Version(one.version) for one in wanted.specifier if one.operator in (">=", "==")]
        results[canonicalize_name(wanted.name)] = max(lowest)
    return results


def versions() -> dict[str, dict[str, Version]]:
    """Which versions of every package are judged: the tested ones and the lowest ones."""
    tested, lowest = pins(ROOT / "constraints.txt"), pins(ROOT / "constraints-lowest.txt")
    kinds = {"tested": tested, "lowest": lower_bounds(), "lowest set": lowest}
    names = sorted({name for those in kinds.values() for name in those})
    return {name: {kind: those[name] for kind, those in kinds.items() if name in those} for name in names}


def page() -> str:
    """The whole page."""
    day, result = looked_up()
    judged = versions()
    reached = {
        name: {kind for kind in kinds if result[name].reaching(kinds[kind])} for name, kinds in judged.items()
    }
    tested = [name for name in judged if "tested" in reached[name]]
    lowest = [name for name in judged if reached[name] and name not in tested]
    passed = [name for name in judged if result[name].advisories and not reached[name]]

    def table(names: list[str], kind: str) -> str:
        """The advisories that reach these packages, and below them why the versions stay."""
        lines = ["| package | advisory | affected | fixed in | what |", "| --- | --- | --- | --- | --- |"]
        for name in names:
            version = judged[name].get(kind)
            rows = result[name].advisories if version is None else result[name].reaching(version)
            lines += [one.row(name) for one in rows]
        lines += [line for name in names if kind for line in ("", f"{name}: {result[name].answer}")]
        return "\n".join(lines)

    lines = [
        f"| {name} | {those.get('tested', '')} | {those.get('lowest', those.get('lowest set', ''))} | "
        f"{result[name].records or ''} | {result[name].searches} | {result[name].newest or ''} | "
        f"{result[name].note} |\n"
        for name, those in judged.items()
    ]
    head = PAGE_HEAD.format(
        day=day, packages=len(judged), searches=sum(result[name].searches for name in judged),
        tested=table(tested, "tested"), lowest=table(lowest, "lowest"), passed=table(passed, ""),
    )  # fmt: skip
    return head + "".join(lines)


if __name__ == "__main__":
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(page())
