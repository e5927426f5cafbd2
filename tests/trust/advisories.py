"""Writes docs/advisories.md: which known security advisories reach a version of a package that is allowed.

    python tests/trust/advisories.py

Reads advisories.yaml beside it (what was looked up, by hand), pyproject.toml and both constraints. Nothing
is asked of a network, so it knows of no advisory that is younger than its list.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "advisories.md"
LIST = Path(__file__).with_name("advisories.yaml")


@dataclass(frozen=True)
class Advisory:
    """One flaw: where it was seen, and the versions that have it."""

    id: str
    aliases: tuple[str, ...]
    affected: tuple[SpecifierSet, ...]
    fixed: str | None
    severity: str | None
    summary: str
    source: str

    def reaches(self, version: Version) -> bool:
        return any(version in those for those in self.affected)


@dataclass(frozen=True)
class Looked:
    """What was found for one package; fields as in advisories.yaml."""

    package: str
    records: int
    searches: int
    newest: str | None
    note: str
    answer: str
    advisories: tuple[Advisory, ...]

    def reaching(self, version: Version) -> tuple[Advisory, ...]:
        return tuple(one for one in self.advisories if one.reaches(version))


def looked_up(file: Path = LIST) -> tuple[str, dict[str, Looked]]:
    """The day, and what was found by package."""
    tree = yaml.safe_load(file.read_text())
    return str(tree["looked_up"]), {row["package"]: _looked(row) for row in tree["packages"]}


def pins(file: Path) -> dict[str, Version]:
    """Versions by package."""
    lines = [
        line.partition("==") for line in file.read_text().splitlines() if "==" in line and line[0] != "#"
    ]
    return {canonicalize_name(name): Version(version) for name, _, version in lines}


def lower_bounds() -> dict[str, Version]:
    """The lowest versions that pyproject.toml allows of what it names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [*project["dependencies"]]
    texts += [text for wanted in project["optional-dependencies"].values() for text in wanted]
    found = {}
    for wanted in map(Requirement, texts):
        least = [Version(one.version) for one in wanted.specifier if one.operator in (">=", "==")]
        found[canonicalize_name(wanted.name)] = max(least)
    return found


def versions() -> dict[str, dict[str, Version]]:
    """Which versions of every package are judged: the tested ones and the lowest ones."""
    tested, lowest = pins(ROOT / "constraints.txt"), pins(ROOT / "constraints-lowest.txt")
    bounds = lower_bounds()
    return {
        name: {
            kind: those[name]
            for kind, those in (("tested", tested), ("lowest", bounds), ("lowest set", lowest))
            if name in those
        }
        for name in sorted({*tested, *lowest, *bounds})
    }


def page() -> str:
    """The whole page."""
    day, found = looked_up()
    judged = versions()
    reached = {
        name: {kind: found[name].reaching(version) for kind, version in those.items()}
        for name, those in judged.items()
    }
    searches = sum(found[name].searches for name in judged)
    pinned = [name for name, kinds in reached.items() if kinds.get("tested")]
    allowed = [name for name, kinds in reached.items() if any(kinds.values()) and name not in pinned]
    passed = [name for name in judged if found[name].advisories and name not in (*pinned, *allowed)]
    lines = [
        "# Security advisories of what derender needs",
        "",
        f"Looked up on {day} for {len(judged)} packages: those of `constraints.txt` (tested) and of",
        f"`constraints-lowest.txt`, and the lower bounds of `pyproject.toml`. {searches} searches over",
        "records of CVE, OSV, GHSA and PyPA and reports about them, up to November 2026, and a copy",
        "of PyPA's advisory database that ends in early 2024. No live database was asked (`pip-audit` found",
        "none that answered): run `pip-audit -r constraints.txt` where there is a network. Empty rows say",
        "that nothing was found, not that there is nothing. This page is written by",
        "`python tests/trust/advisories.py` from `tests/trust/advisories.yaml`; a test holds that list",
        "against the versions.",
        "",
        "## Tested versions that an advisory reaches",
        "",
        *_table(pinned, found, "tested", judged),
        "",
        "## Lowest versions that an advisory reaches, while the tested one is free of it",
        "",
        *_table(allowed, found, "lowest", judged),
        "",
        "## No longer allowed",
        "",
        "Advisories of versions that were allowed before; lower bounds stand above them now.",
        "",
        *_rows(passed, found, judged),
        "",
        "## Every package",
        "",
        "| package | tested | lowest | PyPA's records to 2024 | searches | newest advisory seen | note |",
        "| --- | --- | --- | ---: | ---: | --- | --- |",
    ]
    for name, those in judged.items():
        one = found[name]
        least = those.get("lowest", those.get("lowest set", ""))
        lines.append(
            f"| {name} | {those.get('tested', '')} | {least} | {one.records or ''} | {one.searches} | "
            f"{one.newest or ''} | {one.note} |"
        )
    return "\n".join([*lines, ""])


def _looked(row: dict[str, Any]) -> Looked:
    advisories = [
        Advisory(
            id=one["id"],
            aliases=tuple(one["aliases"]),
            affected=tuple(SpecifierSet(text, prereleases=True) for text in one["affected"]),
            fixed=one["fixed"],
            severity=one["severity"],
            summary=one["summary"],
            source=one["source"],
        )
        for one in row.get("advisories", ())
    ]
    plain = {key: row[key] for key in ("package", "records", "searches", "newest")}
    return Looked(
        **plain, note=row.get("note", ""), answer=row.get("answer", ""), advisories=tuple(advisories)
    )


def _table(
    names: Sequence[str], found: dict[str, Looked], kind: str, judged: dict[str, dict[str, Version]]
) -> list[str]:
    """Rows of the advisories that reach these packages, and below them why the versions stay."""
    lines = _rows(names, found, judged, kind)
    return lines + [line for name in names for line in ("", f"{name}: {found[name].answer}")]


def _rows(
    names: Sequence[str],
    found: dict[str, Looked],
    judged: dict[str, dict[str, Version]],
    kind: str | None = None,
) -> list[str]:
    lines = ["| package | advisory | affected | fixed in | what |", "| --- | --- | --- | --- | --- |"]
    for name in names:
        one = found[name]
        version = judged[name].get(kind or "")
        for advisory in one.advisories if version is None else one.reaching(version):
            affected = "; ".join(", ".join(sorted(map(str, those))) for those in advisory.affected)
            graded = f" ({advisory.severity})" if advisory.severity else ""
            lines.append(
                f"| {name} | [{advisory.id}]({advisory.source}){graded} | {affected} | "
                f"{advisory.fixed or 'not known'} | {advisory.summary.replace('|', '/')} |"
            )
    return lines


if __name__ == "__main__":
    PAGE.write_text(page())
